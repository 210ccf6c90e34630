"""Compares a cloud with the map before it is fused: which returns are on something new.

A return is novel if it ends in space that rays had shown to be free, away from all known surfaces
(the idea of Dynablox: what returns from free space has moved there). A cloud that contradicts the
map as a whole is a fault of the sensor, of the pose or of the unit, and not news.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change.consistency import Compared, judge
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.state.pytrees import Grid

# A novel return is this far from every surface, beside three standard deviations of its range.
_NOVEL_VOXELS = 1.5

# The same for a return that may join a new surface next to it: it may be on the lowest part of a
# thing that stands on the floor.
_JOINS_VOXELS = 0.5


class Novelty(NamedTuple):
    """A cloud compared with the map before it.

    Attributes:
        novel: The return is in space that was free, or beside a new surface, (N,) bool.
        may_join: The return is in space that was free, but may be nearer to known surfaces. If a
            new surface is next to it, it belongs to that, (N,) bool.
        near_new: The return is on or next to a surface that is itself new, (N,) bool.
        consistent: The cloud agrees with the map, or the map cannot judge it, () bool.
        noise: It does not, and its rays disagree with each other, () bool.
    """

    novel: jax.Array
    may_join: jax.Array
    near_new: jax.Array
    consistent: jax.Array
    noise: jax.Array


def compare_cloud(config: Config, grid: Grid, rays: Rays, updates: jax.Array) -> Novelty:
    """Compares a cloud with the map so far.

    Args:
        config: The map's configuration.
        grid: The grid before the cloud is fused.
        rays: The cloud.
        updates: Number of updates of the map, () int32.

    Returns:
        The comparison.
    """
    evidence, derived = grid.evidence, grid.derived
    shape, size = config.grid_shape, config.voxel_size
    index, _, _ = geometry.voxel_of(config, rays.points_world)
    index = split(index)
    voxel = geometry.flat_index(shape, index)
    ends = rays.ends & rays.inside

    patch = lookup.patch_voxel(config, derived, index)
    change = evidence.change.ravel()
    near_new = (change[voxel] > 0) | (change[patch] > 0)

    sdf = derived.sdf.ravel()[voxel].astype(jnp.float32)
    observed = ends & (derived.frontier_steps.ravel()[voxel] > 0)
    hits, passes = (array.ravel()[voxel] for array in (evidence.hits, evidence.passes))
    empty = (hits < config.min_hits) | (hits < config.min_hit_ratio * (hits + jnp.abs(passes)))
    margin = 3 * rays.sigma
    was_free = observed & (passes > 0)
    free = was_free & ((sdf > _NOVEL_VOXELS * size + margin) | near_new)
    # Space that a new thing has hidden: it has moved there, or this is another side of it.
    novel = ends & empty & (free | ((passes < 0) & near_new))
    may_join = ends & empty & was_free & (sdf > _JOINS_VOXELS * size + margin)

    # New things move on: returns near them are expected, and say nothing about the whole cloud.
    compared = Compared(observed & ~near_new, novel, jnp.abs(sdf))
    verdict = judge(config, grid, rays, updates, compared)
    return Novelty(novel, may_join, ends & near_new, verdict.consistent, verdict.noise)
