"""A voxel grid of distances, laid out as cuRobo's `VoxelGrid` expects it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field import queries
from hiosdf_jax._src.field.lattice import check_resolution, sample_counts
from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState, Unknown

_CHUNK = 65536


class VoxelGrid(NamedTuple):
    """Distances at the centers of voxels, positive inside obstacles; made by `voxel_grid`.

    Attributes:
        dims: Edges of the grid, (x, y, z) m.
        voxel_size: Edge of a voxel, m.
        pose: Center of the grid in the world, (x, y, z, qw, qx, qy, qz), m; not rotated.
        feature_tensor: (X * Y * Z,) float16 m, z runs fastest: minus the signed distance, so that
            it is positive inside obstacles. Other libraries take it by DLPack without a copy.
    """

    dims: tuple[float, float, float]
    voxel_size: float
    pose: tuple[float, ...]
    feature_tensor: jax.Array


def voxel_grid(
    field: MapState | Field, voxel_size: float = 0.05, unknown: Unknown = "obstacle"
) -> VoxelGrid:
    """Samples a map at the centers of voxels, for cuRobo and others that take dense grids.

    Example:
        >>> grid = exports.voxel_grid(field, voxel_size=0.05)
        >>> features = torch.from_dlpack(grid.feature_tensor)  # no copy

    Args:
        field: A map, or a snapshot of one.
        voxel_size: Edge of a voxel, m.
        unknown: Policy for unseen space, see `hio.sdf`; by default it is solid.

    Returns:
        The grid. A distance that float16 cannot hold is rounded toward collision.

    Raises:
        ValueError: An argument has a wrong type or value, or the grid has too many voxels.
    """
    edge = check_resolution(voxel_size)
    field = as_live_field(field)
    low, high = np.asarray(field.config.bounds, float)
    shape = np.array(sample_counts(high - low, edge)) - 1  # voxels, not their corners
    count = int(shape.prod())
    inside = np.empty(count, np.float32)

    def sample(row: np.ndarray) -> tuple[np.ndarray]:
        index = np.stack(np.unravel_index(row, shape), axis=-1)
        centers_world = (low + (index + 0.5) * edge).astype(np.float32)
        return (-np.asarray(queries.sdf(field, centers_world, unknown=unknown)),)

    fill_in_chunks(sample, {"sdf": inside}, min(count, _CHUNK))
    dims = shape * edge
    x, y, z = (float(each) for each in dims)
    center = low + dims / 2
    pose = (*(float(each) for each in center), 1.0, 0.0, 0.0, 0.0)
    return VoxelGrid((x, y, z), edge, pose, jnp.asarray(_round_up(inside)))


def _round_up(values: np.ndarray) -> np.ndarray:
    """The nearest float16 values that are not less."""
    rounded = np.clip(values, -65504, 65504).astype(np.float16)
    less = rounded < values
    return np.where(less, np.nextafter(rounded, np.float16(np.inf)), rounded)
