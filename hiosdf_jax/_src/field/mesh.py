"""The surface of a map as a triangle mesh, built from the patches of its grid."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import jax
import numpy as np

from hiosdf_jax._src.field import mean_surface, polygons
from hiosdf_jax._src.field.lattice import check_resolution
from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.numerics.intake import is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState

if TYPE_CHECKING:
    import trimesh

# One batch shape for all vertices: one compilation, and memory does not grow with the map.
_CHUNK = 65536

# About 10 GB while they are made.
_MOST_TRIANGLES = 50_000_000


def extract_mesh(field: MapState | Field, resolution: float = 0.05) -> trimesh.Trimesh:
    """Extracts the observed surfaces of a map.

    The mesh consists of the surface patches of the grid, joined along the edges of the voxels. It
    has surfaces where rays ended, and nowhere else. A sheet that was seen from both sides, such as
    a door, is a single surface. Returns on a line in a voxel, such as two alone, are a strip 1 % of
    a voxel wide. Time and memory follow the surface, not the bounds.

    Args:
        field: A map or a snapshot of one. The network has no part in the mesh.
        resolution: The edges of the triangles are about as long, m, and at most as long as those
            of the voxels.

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
    vertices, normals, faces, is_strip = polygons.triangulate(surface)
    if not len(faces):
        return trimesh.Trimesh()
    halvings = max(0, math.ceil(math.log2(config.voxel_size) - math.log2(spacing) - 1e-6))
    triangles = len(faces) * 4.0 ** min(halvings, 100)
    if triangles > _MOST_TRIANGLES:
        raise ValueError(
            f"resolution is {resolution} m, which needs {triangles:.3g} triangles, expected at "
            f"most {_MOST_TRIANGLES}"
        )
    for _ in range(halvings):
        rows = np.concatenate([vertices, normals, is_strip[:, None]], axis=-1)
        rows, faces = trimesh.remesh.subdivide(rows, faces)[:2]
        vertices, normals, is_strip = rows[:, :3], rows[:, 3:6], rows[:, 6] > 0
    points = ((vertices + config.corner_index) * config.voxel_size).astype(np.float32)
    normals = polygons.unit(normals).astype(np.float32)
    moved, turned = np.empty_like(points), np.empty_like(normals)
    spread = np.empty(len(points), np.float32)

    def move(row: np.ndarray) -> tuple[jax.Array, ...]:
        return _move(config, surface, points[row], normals[row])

    fill_in_chunks(move, {"points": moved, "normals": turned, "spread": spread}, _CHUNK)
    # A strip has no plane to be averaged with others: it lies where its hits are.
    moved[is_strip], turned[is_strip] = points[is_strip], normals[is_strip]
    return trimesh.Trimesh(
        moved,
        faces,
        vertex_normals=turned,
        vertex_attributes={"spread": spread},
        process=False,
    )


_move = jax.jit(plain(mean_surface.move_to_surface), static_argnums=0)
