"""Training samples from the grid (paper, section IV-B)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change.vanishing import is_recent
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.evidence import is_reached
from hiosdf_jax._src.numerics.tiles import map_tiles
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.samples.draw import Samples, draw_from_masks, draw_words, normal, uniform
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Grid, surface_of

# Far samples around changes, where the network is most wrong: their number per changed voxel, their
# largest share of all far samples, and their standard deviation from the voxel.
_PER_CHANGED_VOXEL = 10
_MOST_CHANGED_SHARE = 0.25
_CHANGED_SPREAD_M = 0.2

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
    known = (is_reached(evidence.passes, evidence.hits) | (evidence.behind > 0)) & (
        derived.nearest[..., 0] != NO_FEATURE
    )
    near = known & (jnp.abs(derived.sdf) < config.near_distance)
    recent = is_recent(evidence.change)
    around = round(_MOST_CHANGED_SHARE * config.far_samples)
    count = config.near_samples + config.far_samples
    shapes = (config.near_samples,), (config.far_samples,), (around,), (count, 3), (around, 3)
    *words, place_words, spread_words = draw_words(key, *shapes)
    voxels, (any_near, any_far, _) = draw_from_masks([near, known & ~near, recent], words)
    weight = jnp.concatenate(
        [
            jnp.full(config.near_samples, any_near, jnp.float32),
            jnp.full(config.far_samples, any_far, jnp.float32),
        ]
    )
    points_world = _voxel_centers(config, jnp.concatenate(voxels[:2]))
    points_world += (uniform(place_words) - 0.5) * config.voxel_size
    offset = _CHANGED_SPREAD_M * normal(spread_words)
    moved = _voxel_centers(config, voxels[2]) + offset
    wanted = _PER_CHANGED_VOXEL * jnp.sum(recent, dtype=jnp.int32)
    points_world = _move_to_changes(config, known, points_world, moved, wanted)
    grid_sdf = partial(lookup.grid_sdf, config, surface_of(grid))
    return Samples(points_world, map_tiles(grid_sdf, points_world, _TILE), weight)


def _move_to_changes(
    config: Config,
    known: jax.Array,
    points_world: jax.Array,
    moved_world: jax.Array,
    wanted: jax.Array,
) -> jax.Array:
    """Moves the last points to some places around changes, where the map is known there."""
    count = moved_world.shape[0]
    index, _, inside = geometry.voxel_of(config, moved_world)
    usable = inside & known.ravel()[geometry.flat_index(config.grid_shape, split(index))]
    usable &= jnp.arange(count) < wanted
    kept, replaced = jnp.split(points_world, [points_world.shape[0] - count])
    return jnp.concatenate([kept, jnp.where(usable[:, None], moved_world, replaced)])


def _voxel_centers(config: Config, voxel: jax.Array) -> jax.Array:
    """Returns the centers (N, 3) m of voxels (N,), indices into the raveled grid."""
    index = jnp.stack(jnp.unravel_index(voxel, config.grid_shape), axis=-1)
    return geometry.voxel_center(config, index)
