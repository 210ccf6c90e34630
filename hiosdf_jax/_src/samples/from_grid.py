"""Training samples from the grid (paper, section IV-B)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change.vanishing import is_recent
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.numerics.modes import cond
from hiosdf_jax._src.numerics.tiles import map_tiles
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.samples.draw import Samples, draw_from_mask
from hiosdf_jax._src.state import NO_FEATURE, Grid, surface_of

# Far samples around changes, where the network is most wrong: their number per changed voxel, their
# largest share of all far samples, and their standard deviation from the voxel.
_PER_CHANGED_VOXEL = 10
_MOST_CHANGED_SHARE = 0.25
_CHANGED_SPREAD_M = 0.35

_TILE = 4096  # points whose distances are computed at once on a CPU


def sample_grid(config: Config, grid: Grid, key: jax.Array) -> Samples:
    """Draws points of the known map, with the grid's signed distance.

    Voxels are drawn uniformly from the whole known map: `near_samples` voxels with
    |sdf| < near_distance and `far_samples` others. The point is uniform in its voxel. Up to a
    quarter of the far samples lies around surfaces that appeared or vanished.

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
    near_key, far_key, place_key, change_key = jax.random.split(key, 4)
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
    points_world = _move_to_changes(config, evidence.change, known, points_world, change_key)
    grid_sdf = partial(lookup.grid_sdf, config, surface_of(grid))
    return Samples(points_world, map_tiles(grid_sdf, points_world, _TILE), weight)


def _move_to_changes(
    config: Config, change: jax.Array, known: jax.Array, points_world: jax.Array, key: jax.Array
) -> jax.Array:
    """Moves the last points to places around changes, where the map is known there."""
    recent = is_recent(change)
    count = round(_MOST_CHANGED_SHARE * config.far_samples)
    wanted = _PER_CHANGED_VOXEL * jnp.sum(recent, dtype=jnp.int32)

    def move(points_world: jax.Array) -> jax.Array:
        draw_key, place_key = jax.random.split(key)
        voxel, _ = draw_from_mask(recent, count, draw_key)
        index = jnp.stack(jnp.unravel_index(voxel, config.grid_shape), axis=-1)
        offset = _CHANGED_SPREAD_M * jax.random.normal(place_key, index.shape, jnp.float32)
        around = geometry.voxel_center(config, index) + offset
        index, _, inside = geometry.voxel_of(config, around)
        usable = inside & known.ravel()[geometry.flat_index(config.grid_shape, split(index))]
        usable &= jnp.arange(count) < wanted
        kept = points_world[points_world.shape[0] - count :]
        moved = jnp.where(usable[:, None], around, kept)
        return jnp.concatenate([points_world[: points_world.shape[0] - count], moved])

    return cond(jnp.any(recent), move, lambda points: points, points_world)
