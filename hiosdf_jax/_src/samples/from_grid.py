"""Training samples from the grid (paper, section IV-B)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.samples.draw import Samples, draw_from_mask
from hiosdf_jax._src.state import NO_FEATURE, Grid, surface_of


def sample_grid(config: Config, grid: Grid, key: jax.Array) -> Samples:
    """Draws points of the known map, with the grid's signed distance.

    Voxels are drawn uniformly from the whole known map: `near_samples` voxels with
    |sdf| < near_distance and `far_samples` others. The point is uniform in its voxel.

    Args:
        config: The map's configuration.
        grid: The grid.
        key: Source of randomness.

    Returns:
        near_samples + far_samples samples, with weight 0 where there is no such voxel.
    """
    evidence, derived = grid.evidence, grid.derived
    known = (is_observed(evidence.passes, evidence.hits) | (evidence.behind > 0)) & (
        derived.nearest[..., 0] != NO_FEATURE
    )
    near = known & (jnp.abs(derived.sdf) < config.near_distance)
    near_key, far_key, place_key = jax.random.split(key, 3)
    near_voxel, any_near = draw_from_mask(near, config.near_samples, near_key)
    far_voxel, any_far = draw_from_mask(known & ~near, config.far_samples, far_key)
    voxel = jnp.concatenate([near_voxel, far_voxel])
    weight = jnp.concatenate(
        [
            jnp.full(config.near_samples, any_near, jnp.float32),
            jnp.full(config.far_samples, any_far, jnp.float32),
        ]
    )
    index = jnp.stack(jnp.unravel_index(voxel, config.grid_shape), axis=-1)
    place = jax.random.uniform(place_key, index.shape, jnp.float32, minval=-0.5, maxval=0.5)
    points_world = geometry.voxel_center(config, index) + place * config.voxel_size
    return Samples(points_world, lookup.grid_sdf(config, surface_of(grid), points_world), weight)
