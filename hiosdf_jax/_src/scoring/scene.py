"""Exact distances of a scene: from any triangle mesh, or from iSDF's grids for ReplicaCAD.

A watertight mesh is signed by its solids: negative where the winding number says "inside", or
"outside" for a mesh that is inside out, such as a room. Most meshes of scenes are not watertight.
There a point is free, with a positive distance, if the straight line to it from one of the sensor's
positions crosses no triangle, and behind surfaces otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.files import open_regular, parsing, read_rows
from hiosdf_jax._src.scoring.mesh_file import corners_and_faces, read_mesh

if TYPE_CHECKING:
    import trimesh

_POSITIONS = 32  # sensor positions, evenly along its path, that decide what is free
_CLEAR = 1e-6  # share of a line: a triangle this close to its end does not block it
_THIN = 0.05  # m; a part is thin if its least extent is below this


class Hits(NamedTuple):
    """The first intersections of rays with a scene.

    Attributes:
        range: (R,) float64 m; inf for a ray that meets nothing.
        thin_part: (R,) int64, number of the thin part that the ray meets; -1 for other surfaces.
    """

    range: np.ndarray
    thin_part: np.ndarray


class Scene(NamedTuple):
    """Exact distances of a scene.

    Attributes:
        sdf_and_grad: Maps (N, 3) m, world frame, to distances (N,) m, positive in free space, and
            unit gradients (N, 3), all float64; NaN outside of the scene.
        sdf_to_draw: Maps (N, 3) m to distances (N,) m that are zero on surfaces only. Unsigned if
            the sign depends on what was observed, since it jumps at the edge of a shadow.
        cast: Maps rays, origins (R, 3) m and unit directions (R, 3) in the world frame, to their
            first hits; None for a scene without triangles.
    """

    sdf_and_grad: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    sdf_to_draw: Callable[[np.ndarray], np.ndarray]
    cast: Callable[[np.ndarray, np.ndarray], Hits] | None


def read_scene(path: str | os.PathLike[str], sensor_path_world: np.ndarray) -> Scene:
    """Reads a scene.

    Args:
        path: A triangle mesh, in m and in the stream's world frame: a `.ply`, `.obj`, `.stl`,
            `.off` or `.glb` file; or `sdf.npy` or its folder, see `grid_scene`.
        sensor_path_world: (F, 3) m, the sensor's positions; they decide what is free if the mesh is
            not watertight.

    Returns:
        Its exact distances.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be read as a mesh or a grid.
        ModuleNotFoundError: A mesh needs libigl, which is not installed.

    Example:
        rays = scoring.read_rays(stream, max_range=6.0)
        scene = scoring.read_scene("house.ply", scoring.sensor_path(rays))
    """
    path = Path(path)
    path.stat()
    if path.is_dir() or path.suffix == ".npy":
        return grid_scene(path if path.is_dir() else path.parent)
    mesh = read_mesh(path)
    try:
        return mesh_scene(mesh, sensor_path_world)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def mesh_scene(mesh: trimesh.Trimesh, sensor_path_world: np.ndarray) -> Scene:
    """Takes exact distances from a triangle mesh.

    Args:
        mesh: In m, world frame; see the top of this module for its sign. A part (triangles joined
            by edges) is thin if it is closed and its least extent is below 5 cm.
        sensor_path_world: (F, 3) m, the sensor's positions.

    Returns:
        The scene.

    Raises:
        ValueError: The mesh has no triangles, or corners that are not there or not finite; or the
            path is not (F, 3), finite, F > 0.
        ModuleNotFoundError: libigl is not installed.

    Example:
        path_world = scoring.sensor_path(scoring.read_rays(stream))
        scene = scoring.mesh_scene(trimesh.load("house.ply"), path_world)
    """
    vertices, faces, tree = triangle_tree(mesh)
    positions = _spread_positions(sensor_path_world)
    # trimesh's own normals stay as they were when a mesh is turned inside out.
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    is_solid = bool(mesh.is_watertight and mesh.is_winding_consistent)
    part_of_face = _thin_parts(mesh)

    def first_triangle(origins: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The first triangle on each line, -1 for none, and the share of the line up to it."""
        face, where, _ = tree.intersect_ray_first(vertices, faces, origins.copy(), lines.copy())
        return np.asarray(face), np.asarray(where)

    def is_free(points: np.ndarray) -> np.ndarray:
        if is_solid:
            import igl

            # For a mesh that is inside out, the winding number is 0 in its solid and -1 outside.
            winding = np.asarray(igl.fast_winding_number(vertices, faces, points))
            return winding < (0.5 if mesh.volume > 0 else -0.5)
        free = np.full(len(points), False)
        for position in positions:
            rest = np.flatnonzero(~free)
            lines = points[rest] - position
            blocker, where = first_triangle(np.broadcast_to(position, lines.shape), lines)
            free[rest] = (blocker < 0) | (where >= 1 - _CLEAR)
        return free

    def sdf_and_grad(points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = np.array(points_world, float)
        squared, face, nearest = tree.squared_distance(vertices, faces, points)
        face, distance = np.asarray(face), np.sqrt(squared)
        sign = np.where(is_free(points), 1.0, -1.0)
        offset = sign[:, None] * (points - nearest)
        # On the surface the offset has no direction: the normal replaces it.
        on_surface = distance[:, None] < 1e-9
        grad = np.where(
            on_surface, normals[face], offset / np.where(on_surface, 1, distance[:, None])
        )
        return sign * distance, grad

    def cast(origins_world: np.ndarray, directions_world: np.ndarray) -> Hits:
        face, where = first_triangle(origins_world, directions_world)
        hit = face >= 0
        return Hits(
            range=np.where(hit, where, np.inf),
            thin_part=np.where(hit, part_of_face[np.where(hit, face, 0)], -1),
        )

    def sdf_to_draw(points_world: np.ndarray) -> np.ndarray:
        if is_solid:
            return sdf_and_grad(points_world)[0]
        return np.sqrt(tree.squared_distance(vertices, faces, np.array(points_world, float))[0])

    return Scene(sdf_and_grad, sdf_to_draw, cast)


def triangle_tree(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray, Any]:
    """Builds the tree that finds the triangle of a mesh nearest to a point.

    Args:
        mesh: In m.

    Returns:
        Corners (V, 3) float64, triangles (F, 3) int64, and the `igl.AABB`, which takes both.

    Raises:
        ValueError: The mesh has no triangles, or corners that are not there or not finite.
        ModuleNotFoundError: libigl is not installed.
    """
    try:
        import igl
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "distances to a mesh need libigl: in a clone, pip install '.[truth]'"
        ) from error

    vertices, faces = corners_and_faces(mesh)
    tree = igl.AABB()
    tree.init(vertices, faces)
    return vertices, faces, tree


def grid_scene(folder: str | os.PathLike[str]) -> Scene:
    """Takes distances from a grid of samples, as iSDF stores its ground truth for ReplicaCAD.

    Distances are interpolated trilinearly between samples. Gradients are central differences over
    two steps of the grid. A sample of exactly 0 means no data.

    Args:
        folder: The folder with `sdf.npy`, (X, Y, Z) m, positive in free space, and `transform.txt`,
            (4, 4) numbers that map an index to m in the world frame: the spacing of each axis on
            the diagonal, and the position of sample (0, 0, 0).

    Returns:
        The scene; it cannot cast rays.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is malformed.
    """
    from scipy.interpolate import RegularGridInterpolator

    samples, spacing, corner = _read_grid(Path(folder))
    axes = [
        low + step * np.arange(n)
        for low, step, n in zip(corner, spacing, samples.shape, strict=True)
    ]
    sdf_at = RegularGridInterpolator(axes, samples, bounds_error=False, fill_value=np.nan)

    def sdf_and_grad(points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points_world, float)
        slopes = [
            (sdf_at(points + step) - sdf_at(points - step)) / (2 * step.sum())
            for step in np.diag(spacing)
        ]
        slope = np.stack(slopes, axis=-1)
        length = np.linalg.norm(slope, axis=-1, keepdims=True)
        return sdf_at(points), slope / np.where(length > 0, length, np.nan)

    return Scene(sdf_and_grad, lambda points: sdf_at(np.asarray(points, float)), None)


def _spread_positions(sensor_path_world: np.ndarray) -> np.ndarray:
    """Up to 32 positions, evenly along a path."""
    path = np.asarray(sensor_path_world, float)
    if path.ndim != 2 or path.shape[1] != 3 or not len(path):
        raise ValueError(f"sensor_path_world has shape {path.shape}, expected (F, 3), F > 0")
    if not np.isfinite(path).all():
        raise ValueError("sensor_path_world has positions that are not finite, expected m")
    return path[np.linspace(0, len(path) - 1, min(len(path), _POSITIONS)).astype(int)]


def _thin_parts(mesh: trimesh.Trimesh) -> np.ndarray:
    """Number of the thin part that each triangle belongs to, (T,) int64; -1 for none."""
    import trimesh

    part_of_face = np.full(len(mesh.faces), -1, np.int64)
    # Without merged corners, every triangle of a soup would be a part.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    labels = trimesh.graph.connected_component_labels(
        merged.face_adjacency, node_count=len(merged.faces)
    )
    edges = np.sort(merged.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edge, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    open_faces = (uses[edge.ravel()] == 1).reshape(-1, 3).any(axis=1)
    is_open = np.zeros(labels.max() + 1, bool)
    is_open[labels[open_faces]] = True
    order = np.argsort(labels, kind="stable")
    _, starts = np.unique(labels[order], return_index=True)
    for label, rows in enumerate(np.split(order, starts[1:])):
        if is_open[label]:  # a sheet has no thickness, and may as well be a wall
            continue
        corners = merged.vertices[np.unique(merged.faces[rows])]
        if np.sort(np.linalg.eigvalsh(np.cov(corners.T)))[0] > _THIN**2:
            continue  # spread wider than the limit in every direction: no box needed
        try:
            box = trimesh.bounds.oriented_bounds(corners)[1]
        except Exception:  # qhull fails on parts that are exactly flat
            box = np.ptp(corners, axis=0)
        if min(box) < _THIN:
            part_of_face[rows] = label
    return part_of_face


def _read_grid(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples (X, Y, Z) float32 m, NaN for no data; their spacing (3,) and corner (3,), m."""
    grid_file, transform_file = folder / "sdf.npy", folder / "transform.txt"
    open_regular(grid_file).close()
    with parsing(grid_file, "npy file"):
        # Memory-mapped, and converted to float32 below: at 1 cm an apartment takes gigabytes.
        grid = np.load(grid_file, mmap_mode="r", allow_pickle=False)
    if not (isinstance(grid, np.ndarray) and grid.ndim == 3 and min(grid.shape) >= 2):
        found = getattr(grid, "shape", type(grid).__name__)
        raise ValueError(f"{grid_file}: has shape {found}, expected (X, Y, Z), each at least 2")
    if grid.dtype.kind != "f":
        raise ValueError(f"{grid_file}: has type {grid.dtype}, expected floating-point numbers")
    transform, _ = read_rows(transform_file, 4)
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise ValueError(
            f"{transform_file}: has shape {transform.shape}, expected 4 lines of 4 finite numbers"
        )
    spacing, corner = np.diag(transform)[:3], transform[:3, 3]
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = corner
    if not ((spacing > 0).all() and np.allclose(transform, affine)):
        raise ValueError(
            f"{transform_file}: is {transform.tolist()}, expected nothing but spacings > 0 on the "
            "diagonal, a position in the last column and 1 in the corner"
        )
    samples = np.array(grid, np.float32)
    samples[samples == 0] = np.nan
    return samples, spacing, corner
