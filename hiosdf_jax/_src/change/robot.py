"""The space that the robot's body fills holds no surface: what was mapped there is a ghost."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import EvidenceWindow, clear_patches
from hiosdf_jax._src.numerics.vectors import each, length, split, take

# Samples across a sphere; they meet every voxel of spheres up to five voxels in radius.
_ACROSS = 11


def clear_robot(
    config: Config, window: EvidenceWindow, centers_world: jax.Array, radii: jax.Array
) -> EvidenceWindow:
    """Removes the patches whose centers lie in the robot's spheres.

    Args:
        config: The map's configuration.
        window: The evidence around the sensor.
        centers_world: Centers of the robot's spheres, (K, 3) m.
        radii: Their radii, (K,) m.

    Returns:
        The window; cleared voxels are free.
    """
    lattice = np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, _ACROSS)], indexing="ij"), axis=-1)
    samples = lattice.reshape(1, -1, 3).astype(np.float32) * radii[:, None, None]
    samples_world = centers_world[:, None] + samples
    shape, size = window.hits.shape, config.voxel_size
    index, _, inside = geometry.voxel_of_window(config, window.start, shape, samples_world)
    voxel = jnp.where(inside, geometry.flat_index(shape, split(index)), 0)
    voxel_world = geometry.voxel_center(config, window.start + index)
    mean = take(window.mean.reshape(-1, 3), voxel)
    offset = each(
        lambda v, m, c: v + m * size - c[:, None],
        split(voxel_world),
        mean,
        split(centers_world),
    )
    mapped = inside & (window.hits.ravel()[voxel] > 0)
    ghost = mapped & (length(offset) < radii[:, None])
    target = jnp.where(ghost, voxel, window.hits.size).ravel()

    return clear_patches(window, target, 0)
