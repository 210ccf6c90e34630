"""The surface of a map as a triangle mesh, built from the patches of its grid."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import jax
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field import contouring, implicit_surface
from hiosdf_jax._src.field.contouring import CELLS_PER_VOXEL, PADDING
from hiosdf_jax._src.field.implicit_surface import Level
from hiosdf_jax._src.field.lattice import check_resolution
from hiosdf_jax._src.field.patch_layers import join, nearest_of, spread_around
from hiosdf_jax._src.field.patch_neighbors import dot
from hiosdf_jax._src.field.patch_rectangles import (
    Patches,
    Triangles,
    as_rectangles,
    find_patches,
    with_patches,
)
from hiosdf_jax._src.field.patch_smoothing import smooth
from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.numerics.intake import is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState, Surface

if TYPE_CHECKING:
    import trimesh

# One batch shape for all points: one compilation, and memory does not grow with the map. 65,536
# take more than twice as long on a CPU: they do not fit in its cache.
_CHUNK = 16384

# About 10 GB while they are made.
_MOST_TRIANGLES = 50_000_000

# The center and the corners of a patch, in half edges.
_CHECKED = ((0.0, 0.0), (-0.8, -0.8), (-0.8, 0.8), (0.8, -0.8), (0.8, 0.8))

# A point of a patch is not on the contour if the nearest vertex is this far, voxels. Vertices are
# half a voxel apart.
_FAR_VOXELS = 0.5

# A point this far above or below the contour, voxels, is not on it either. That counts in free
# space only: where walls meet, the patches lie across the crease, and the contour is better.
_OFF_VOXELS = 0.07

# A shorter patch, voxels to each side, is a single hit and is not drawn.
_LEAST_LENGTH = 5e-3

# The corners of triangles lie between the points where the surface crosses the lattice. They move
# onto the surface if it is at most this far, voxels.
_MOVED_VOXELS = 0.3

# Points along each side of a patch that mark the cells of the lattice near it, and their distance
# from it on both of its sides, voxels: the surface may lie on a face of cells.
_MARKS = 5
_BESIDE_VOXELS = 0.1


def extract_mesh(field: MapState | Field, resolution: float = 0.05) -> trimesh.Trimesh:
    """Extracts the observed surfaces of a map.

    The mesh is the zero level of a blend of the grid's surface patches, after each took the plane
    through it and those that continue it. Stacked layers of patches, which noise leaves, become one
    surface. The mesh has surfaces where rays ended, and closes gaps between them that are narrower
    than 0.6 voxels. A sheet that was seen from both sides, such as a door, is a single surface, or
    two if it is thicker than 0.2 voxels. A patch that the level misses, such as a part of a thin
    leg, is a rectangle in its voxel. If its returns lie on a line, as two alone do, it is 1 % of a
    voxel wide. Time and memory follow the surface, but for 60 bytes per voxel.

    Args:
        field: A map or a snapshot of one. The network has no part in the mesh.
        resolution: The edges of the triangles are about as long, m, and at most about as long as
            half a voxel.

    Returns:
        The mesh, m, world frame, with vertex normals on the side that the sensor was on; without
        faces if the map shows no surface. `vertex_attributes["spread"]` has the standard deviation
        of the hits around each vertex along its normal, m.

    Raises:
        ValueError: `field` is something else, or traced; or the resolution is not positive, or
            needs more than 50 million triangles.

    Example:
        >>> hio.extract_mesh(field, resolution=0.05).export("mesh.ply")
    """
    import trimesh

    spacing = check_resolution(resolution)
    field = as_live_field(field)
    if is_traced(*jax.tree.leaves(field)):
        raise ValueError("field is traced, expected a map: call extract_mesh outside jit")
    config, surface = field.config, field.surface
    found = find_patches(surface)
    found = found.part(np.linalg.norm(found.axes[:, 0], axis=-1) > _LEAST_LENGTH)
    if not len(found.center):
        return trimesh.Trimesh()
    joined = join(found, config.grid_shape)
    patches = smooth(joined.patches, config.grid_shape)
    nearest = nearest_of(np.asarray(surface.derived.nearest), found, joined)
    surface = with_patches(surface, patches, nearest)

    def function(position: np.ndarray) -> Level:
        return _evaluate_in_chunks(config, surface, position)

    vertex, face = contouring.contour(_points_near(patches, config.grid_shape), function)
    coarsest = config.voxel_size / CELLS_PER_VOXEL
    halvings = max(0, math.ceil(math.log2(coarsest) - math.log2(spacing) - 1e-6))
    whole = _move_to_surface(vertex, face, function)
    alone = as_rectangles(joined.patches.part(_are_missed(patches, whole)))
    triangles = (len(face) + 4 * len(alone.face)) * 4.0 ** min(halvings, 100)
    if triangles > _MOST_TRIANGLES:
        raise ValueError(
            f"resolution is {resolution} m, which needs {triangles:.3g} triangles, expected at "
            f"most {_MOST_TRIANGLES}"
        )
    if halvings:
        whole = _move_to_surface(*_split(whole.vertex, face, halvings), function)
    rows = np.column_stack([alone.vertex, alone.normal, alone.spread])
    rows, face = _split(rows, alone.face, halvings + 1)  # their edges are a voxel long
    alone = Triangles(rows[:, :3], rows[:, 3:6], rows[:, 6], face)
    vertices = np.concatenate([whole.vertex, alone.vertex])
    spread = np.concatenate([whole.spread, alone.spread])
    spread = np.maximum(spread, spread_around(joined, config.grid_shape, vertices))
    return trimesh.Trimesh(
        ((vertices + config.corner_index) * config.voxel_size).astype(np.float32),
        np.concatenate([whole.face, alone.face + len(whole.vertex)]),
        vertex_normals=np.concatenate([whole.normal, alone.normal]),
        vertex_attributes={"spread": spread * config.voxel_size},
        process=False,
    )


def _points_near(patches: Patches, shape: tuple[int, ...]) -> np.ndarray:
    """Marks the corners of the cells of the lattice in which patches lie, bool."""
    most = np.multiply(shape, CELLS_PER_VOXEL)
    near = np.zeros(most + 1 + 2 * PADDING, bool)
    # One flat index is faster than three. A bool is one byte, so its strides count elements.
    flat, stride = near.reshape(-1), np.array(near.strides)
    center, axes = CELLS_PER_VOXEL * patches.center, CELLS_PER_VOXEL * patches.axes
    beside, along = CELLS_PER_VOXEL * _BESIDE_VOXELS * patches.normal, np.linspace(-1, 1, _MARKS)
    for a, b, c in itertools.product(along, along, (-1, 1)):
        mark = center + a * axes[:, 0] + b * axes[:, 1] + c * beside
        cell = np.clip(np.floor(mark), 0, most - 1).astype(int)
        flat[(cell + PADDING) @ stride] = True
    for axis in range(3):
        marked, before = (np.moveaxis(array, axis, 0) for array in (near, near.copy()))
        marked[1:] |= before[:-1]
    return near


def _are_missed(patches: Patches, contour: Triangles) -> np.ndarray:
    """Returns a mask of the patches that are not on a contour, (M,) bool."""
    from scipy.spatial import KDTree

    if not len(contour.vertex):
        return np.ones(len(patches.center), bool)
    tree = KDTree(contour.vertex)
    far, off = np.zeros((2, len(patches.center)), int)
    for a, b in _CHECKED:
        point = patches.center + a * patches.axes[:, 0] + b * patches.axes[:, 1]
        distance, row = tree.query(point, workers=-1)
        height = dot(point - contour.vertex[row], contour.normal[row])
        far += distance > _FAR_VOXELS
        off += np.abs(height) > _OFF_VOXELS
    # One corner may be a gap's or the border's.
    return (far > 1) | (patches.in_free_space & (far + off > 0))


def _move_to_surface(
    vertex: np.ndarray, face: np.ndarray, function: contouring.Function
) -> Triangles:
    """Moves the corners of triangles onto the surface.

    Args:
        vertex: (V, 3) voxels.
        face: Rows of vertices, (F, 3).
        function: Has the surface as its zero level.

    Returns:
        The triangles.
    """
    level = function(vertex)
    near = np.abs(level.height) < _MOVED_VOXELS
    height = np.where(near, level.height, 0)
    return Triangles(vertex - height[:, None] * level.normal, level.normal, level.spread, face)


def _split(rows: np.ndarray, face: np.ndarray, halvings: int) -> tuple[np.ndarray, np.ndarray]:
    """Splits each triangle into four, `halvings` times.

    Args:
        rows: Values of the vertices, interpolated at the new ones, (V, K).
        face: Rows of vertices, (F, 3).
        halvings: How often.

    Returns:
        The values (W, K) and the triangles (G, 3).
    """
    import trimesh

    for _ in range(halvings if len(face) else 0):
        rows, face = trimesh.remesh.subdivide(rows, face)[:2]
    return rows, face


def _evaluate_in_chunks(config: Config, surface: Surface, positions: np.ndarray) -> Level:
    """Evaluates the surface's function at positions (N, 3), voxels from the grid's corner."""
    points_world = (positions + config.corner_index) * config.voxel_size
    points_world = points_world.astype(np.float32)
    count = len(points_world)
    shapes = {"normal": (count, 3), "plane_normal": (count, 3)}
    level = {name: np.empty(shapes.get(name, count), np.float32) for name in Level._fields}

    def evaluate(row: np.ndarray) -> Level:
        return _evaluate(config, surface, points_world[row])

    fill_in_chunks(evaluate, level, _CHUNK)
    return Level(**level)


_evaluate = jax.jit(plain(implicit_surface.evaluate), static_argnums=0)
