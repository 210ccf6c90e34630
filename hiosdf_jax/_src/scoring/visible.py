"""Exact distances of a scene: from any triangle mesh, or from iSDF's grids for ReplicaCAD.

What they are wanted for is `sample_visible`: points in the free space that a stream has seen.

The sign of a mesh's distances is that of its solids where it is watertight: negative where the
winding number says "inside", or for a mesh that is inside out (a room, say) "outside". Most meshes
of scenes are not; there a point counts as free, with a positive distance, if the straight line to
it from one of the sensor's positions crosses no triangle, and as behind surfaces otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame
from hiosdf_jax._src.scoring.metrics import GroundTruth, choose_thin

if TYPE_CHECKING:
    import trimesh

_RAYS_PER_FRAME = 10_000
_POSITIONS = 32  # of the sensor, evenly along its path, that tell what is free
_TOLERANCE = 0.2  # m, within which a return must meet the scene to tell what was visible
_LEAST_AGREEMENT = 0.5  # share of the returns that do so
_CLEAR = 1e-6  # of a line's length: a triangle this near to its end does not block it

_THIN = 0.05  # m, parts whose least extent is less are thin


class Rays(NamedTuple):
    """Returns of a stream, as rays.

    Attributes:
        frame: (R,) int32, ascending.
        origin_world: (R, 3) float64 m, the sensor's position.
        direction_world: (R, 3) float64, unit vectors.
        range: (R,) float64 m, measured.
    """

    frame: np.ndarray
    origin_world: np.ndarray
    direction_world: np.ndarray
    range: np.ndarray


class Hits(NamedTuple):
    """Where rays first meet a scene.

    Attributes:
        range: (R,) float64 m; inf where they meet nothing.
        thin_part: (R,) int64, number of the thin part that they meet; -1 for anything else.
    """

    range: np.ndarray
    thin_part: np.ndarray


class Scene(NamedTuple):
    """Exact distances of a scene.

    Attributes:
        sdf_and_grad: Takes (N, 3) m, world, to distances (N,) m, positive in free space, and unit
            gradients (N, 3), all float64; NaN where the scene does not reach.
        sdf_to_draw: Takes (N, 3) m to distances (N,) m whose zeros are surfaces and nothing else:
            without a sign where that tells what was seen, since it jumps at the edge of a shadow.
        cast: Takes rays to where they first meet the scene; None for a scene without triangles.
    """

    sdf_and_grad: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    sdf_to_draw: Callable[[np.ndarray], np.ndarray]
    cast: Callable[[Rays], Hits] | None


def read_scene(path: str | os.PathLike[str], sensor_path_world: np.ndarray) -> Scene:
    """Reads a scene.

    Args:
        path: A file with a triangle mesh, in metres and the stream's world frame, of any kind that
            trimesh reads; or `sdf.npy` or its folder, see `grid_scene`.
        sensor_path_world: (F, 3) m, the sensor's positions; they tell what is free where the mesh
            is not watertight.

    Returns:
        Its exact distances.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be read as a mesh or a grid.
        ModuleNotFoundError: A mesh needs libigl, which is not installed.
    """
    path = Path(path)
    path.stat()
    if path.is_dir() or path.suffix == ".npy":
        return grid_scene(path if path.is_dir() else path.parent)
    import trimesh

    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # readers of many formats raise as many things
        raise ValueError(f"{path}: cannot be read as a mesh ({error})") from error
    try:
        return mesh_scene(mesh, sensor_path_world)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def mesh_scene(mesh: trimesh.Trimesh, sensor_path_world: np.ndarray) -> Scene:
    """Takes exact distances from a triangle mesh.

    Args:
        mesh: In metres, world frame; how it is signed is told at the top of this module. Parts of
            it (triangles joined by edges) that are closed and whose least extent is below 5 cm
            count as thin.
        sensor_path_world: (F, 3) m, the sensor's positions.

    Returns:
        The scene.

    Raises:
        ValueError: The mesh has no triangles, or corners that are not finite; or the path is not
            (F, 3), finite, F > 0.
        ModuleNotFoundError: libigl is not installed.
    """
    try:
        import igl
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "distances to a mesh need libigl: pip install 'hiosdf_jax[truth]'"
        ) from error

    vertices = np.array(mesh.vertices, float)
    faces = np.array(mesh.faces, np.int64)
    if not len(faces):
        raise ValueError("the mesh has 0 triangles, expected at least 1")
    if not np.isfinite(vertices).all():
        raise ValueError("the mesh has corners that are not finite")
    path_world = np.asarray(sensor_path_world, float)
    if path_world.ndim != 2 or path_world.shape[1] != 3 or not len(path_world):
        raise ValueError(f"sensor_path_world has shape {path_world.shape}, expected (F, 3), F > 0")
    if not np.isfinite(path_world).all():
        raise ValueError("sensor_path_world has positions that are not finite")
    chosen = np.linspace(0, len(path_world) - 1, min(len(path_world), _POSITIONS)).astype(int)
    positions = path_world[chosen]
    # Not trimesh's own, which stay as they were when a mesh is turned inside out.
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    is_solid = bool(mesh.is_watertight and mesh.is_winding_consistent)
    part_of_face = _thin_parts(mesh)
    tree = igl.AABB()
    tree.init(vertices, faces)

    def first_triangle(origins: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The triangle that each line meets first, -1 for none, and at which share of it."""
        face, where, _ = tree.intersect_ray_first(vertices, faces, origins.copy(), lines.copy())
        return np.asarray(face), np.asarray(where)

    def is_free(points: np.ndarray) -> np.ndarray:
        if is_solid:
            # Of a mesh that is inside out, 0 is inside of its solid and -1 outside.
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
        # On the surface itself the normal stands in for an offset without direction.
        on_surface = distance[:, None] < 1e-9
        grad = np.where(
            on_surface, normals[face], offset / np.where(on_surface, 1, distance[:, None])
        )
        return sign * distance, grad

    def cast(rays: Rays) -> Hits:
        face, where = first_triangle(rays.origin_world, rays.direction_world)
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


def grid_scene(folder: str | os.PathLike[str]) -> Scene:
    """Takes distances from a grid of samples in the layout of iSDF's ground truth for ReplicaCAD.

    Between samples the distance is interpolated trilinearly; the gradient is that of central
    differences over two steps of the grid. A sample of exactly 0 is no data.

    Args:
        folder: With `sdf.npy`, (X, Y, Z) m, positive in free space, and `transform.txt`, (4, 4)
            numbers that take an index to metres in the world: a spacing on the diagonal for each
            axis, and the position of sample (0, 0, 0).

    Returns:
        The scene; it can cast no rays.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file is not what it should be.
    """
    from scipy.interpolate import RegularGridInterpolator

    grid_file, transform_file = Path(folder) / "sdf.npy", Path(folder) / "transform.txt"
    try:
        # Mapped, and halved below: at 1 cm a flat takes gigabytes.
        grid = np.load(grid_file, mmap_mode="r", allow_pickle=False)
    except (EOFError, ValueError) as error:
        raise ValueError(f"{grid_file}: not a readable npy file ({error})") from error
    if not (isinstance(grid, np.ndarray) and grid.ndim == 3 and min(grid.shape) >= 2):
        found = getattr(grid, "shape", type(grid).__name__)
        raise ValueError(f"{grid_file}: has shape {found}, expected (X, Y, Z) of 2 or more each")
    if grid.dtype.kind != "f":
        raise ValueError(f"{grid_file}: has type {grid.dtype}, expected floating point numbers")
    try:
        transform = np.loadtxt(transform_file)
    except ValueError as error:
        raise ValueError(f"{transform_file}: {error}, expected 4 lines of 4 numbers") from error
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
    axes = [
        low + step * np.arange(n) for low, step, n in zip(corner, spacing, grid.shape, strict=True)
    ]
    samples = np.array(grid, np.float32)
    samples[samples == 0] = np.nan
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


def read_rays(stream: Stream, max_range: float = np.inf) -> Rays:
    """Draws returns from each frame of a stream, in one pass over it with a progress bar.

    Args:
        stream: The frames; those that cannot be used are passed over.
        max_range: Farther returns are left out, m.

    Returns:
        Up to 10,000 returns of each frame.

    Raises:
        ValueError: No frame has a return in range.
    """
    from tqdm import tqdm

    rng = np.random.default_rng(0)
    frames, origins, directions, ranges = [], [], [], []
    for i in tqdm(range(len(stream)), desc="reading rays", unit="frame"):
        try:
            cloud, pose = read_frame(stream, i)
        except BadFrameError:
            continue
        lengths = np.linalg.norm(cloud.astype(float), axis=-1)  # NaN for no return
        usable = np.flatnonzero((lengths > 0) & (lengths <= max_range))
        drawn = np.sort(rng.choice(usable, min(_RAYS_PER_FRAME, len(usable)), replace=False))
        arrows = cloud[drawn].astype(float) @ pose[:3, :3].T.astype(float)
        length = np.linalg.norm(arrows, axis=-1)
        frames.append(np.full(len(drawn), i, np.int32))
        origins.append(np.broadcast_to(pose[:3, 3].astype(float), arrows.shape))
        directions.append(arrows / length[:, None])
        ranges.append(length)
    if not sum(map(len, frames)):
        raise ValueError(
            f"none of the {len(stream)} frames has a return within {max_range} m, expected some"
        )
    return Rays(*(np.concatenate(parts) for parts in (frames, origins, directions, ranges)))


def sensor_path(rays: Rays) -> np.ndarray:
    """Lists where the sensor was.

    Args:
        rays: From `read_rays`.

    Returns:
        (F, 3) float64 m, world, one position for each frame that has rays.
    """
    return rays.origin_world[np.unique(rays.frame, return_index=True)[1]]


def sample_visible(scene: Scene, rays: Rays, count: int = 25_000, seed: int = 1) -> GroundTruth:
    """Draws points of the free space that a stream sees, with the exact distances there.

    The frame of a point is drawn uniformly, then one of its rays, then the place on the ray between
    the sensor and the surface: where the ray meets the mesh or, of a scene that can cast no rays,
    where it returned. Rays that return more than 0.2 m from the scene's surface are left out: they
    met something that the scene does not have.

    Args:
        scene: The exact distances.
        rays: Of the stream.
        count: How many points in free space, and how many on surfaces, are wanted; somewhat fewer
            come back where frames have no rays or the scene has gaps.
        seed: Of the draws.

    Returns:
        The exact distances. Thin parts that fewer than 10 of the rays met are left out.

    Raises:
        ValueError: Fewer than half of the returns lie near the scene's surface: it is in another
            frame or unit.
    """
    rng = np.random.default_rng(seed)
    returns_world = rays.origin_world + rays.range[:, None] * rays.direction_world
    thin_part = np.full(len(rays.range), -1)
    if scene.cast is not None:
        lengths, thin_part = scene.cast(rays)
        met = np.abs(lengths - rays.range) <= _TOLERANCE
    else:
        lengths = rays.range
        met = np.abs(scene.sdf_and_grad(returns_world)[0]) <= _TOLERANCE  # False for NaN
    if met.mean() < _LEAST_AGREEMENT:
        raise ValueError(
            f"only {met.mean():.0%} of the stream's returns lie within {_TOLERANCE} m of the "
            f"ground truth's surface, expected {_LEAST_AGREEMENT:.0%}: is it in metres, and in the "
            "stream's world frame?"
        )
    frames = np.unique(rays.frame[met])
    quotas = rng.multinomial(count, np.full(len(frames), 1 / len(frames)), size=2).T
    free, surface = [], []
    for frame, (free_quota, surface_quota) in zip(frames, quotas, strict=True):
        usable = np.flatnonzero(met & (rays.frame == frame))
        free.append(rng.choice(usable, free_quota))
        surface.append(rng.choice(usable, surface_quota))
    free, surface = np.concatenate(free), np.concatenate(surface)

    def at(rows: np.ndarray, shares: np.ndarray | float = 1.0) -> np.ndarray:
        steps = (shares * lengths[rows])[:, None] * rays.direction_world[rows]
        # Rounded before the distance is taken, so that it is exact at the very points handed out.
        return (rays.origin_world[rows] + steps).astype(np.float32)

    points = at(free, rng.uniform(size=len(free)))
    sdf, grad = scene.sdf_and_grad(points)
    if scene.cast is not None:
        # The line from the sensor is free whatever the sign says of places that it cannot tell.
        grad, sdf = np.where(sdf[:, None] < 0, -grad, grad), np.abs(sdf)
    known = np.isfinite(sdf) & np.isfinite(grad).all(axis=-1)
    surface_points = at(surface)
    if scene.cast is None:
        offset, normal = scene.sdf_and_grad(surface_points)
        surface_points = (surface_points - offset[:, None] * normal).astype(np.float32)
        surface_points = surface_points[np.isfinite(surface_points).all(axis=-1)]
    return GroundTruth(
        points_world=points[known],
        sdf=sdf[known].astype(np.float32),
        grad=grad[known].astype(np.float32),
        frame=rays.frame[free[known]],
        surface_points_world=surface_points,
        thin_points_world=at(choose_thin(np.where(met, thin_part, -1), rng)),
    )


def _thin_parts(mesh: trimesh.Trimesh) -> np.ndarray:
    """Number of the thin part that each triangle belongs to, (T,) int64; -1 for none."""
    import trimesh

    part_of_face = np.full(len(mesh.faces), -1, np.int64)
    # Without the corners merged, each triangle of a soup would be a part.
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
        if is_open[label]:  # a sheet: it has no thickness, and is as likely a wall
            continue
        corners = merged.vertices[np.unique(merged.faces[rows])]
        if np.sort(np.linalg.eigvalsh(np.cov(corners.T)))[0] > _THIN**2:
            continue  # spread over more than its thickness may be: spare it the box
        try:
            box = trimesh.bounds.oriented_bounds(corners)[1]
        except Exception:  # qhull's: flat to the last digit
            box = np.ptp(corners, axis=0)
        if min(box) < _THIN:
            part_of_face[rows] = label
    return part_of_face
