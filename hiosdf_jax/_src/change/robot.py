"""The space that the robot's body fills holds no surface: what was mapped there is a ghost."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import EvidenceWindow, clear_patches
from hiosdf_jax._src.numerics.masks import first_true_indices
from hiosdf_jax._src.numerics.vectors import each, length, split

# Patches in the box around all spheres that are judged, in the order of their voxels; those beyond
# stay as they are. The faces of a box of 3 m cross 5,400 voxels of 10 cm and 86,400 of 2.5 cm.
_MOST_PATCHES = 32_768


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
    voxel_world = geometry.window_centers(config, window.start, window.hits.shape)
    center = each(
        lambda v, m: (v + m.astype(jnp.float32) * config.voxel_size).ravel(),
        voxel_world,
        split(window.mean),
    )

    # Only patches near the robot are compared with each sphere.
    def near(c: jax.Array, k: int) -> jax.Array:
        low, high = centers_world[:, k] - radii, centers_world[:, k] + radii
        return (c >= jnp.min(low)) & (c <= jnp.max(high))

    mapped = window.hits.ravel() > 0
    for k in range(3):
        mapped &= near(center[k], k)
    count = window.hits.size
    row = first_true_indices(mapped, min(count, _MOST_PATCHES))
    patch = each(lambda c: c[jnp.minimum(row, count - 1), None], center)
    apart = length(each(jnp.subtract, patch, split(centers_world)))
    ghost = jnp.any(apart < radii, axis=1)
    return clear_patches(window, jnp.where(ghost, row, count), 0)
