"""Rays that go through surfaces of the map: a scale or a pose that is wrong pierces the walls."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.loops import rounds_per_step
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.state.pytrees import Grid

# A ray has pierced a surface where a voxel's center is this far behind it. Its end may lie this far
# behind the surface, beside three standard deviations of its range.
_BEHIND_VOXELS = 0.5
_TOLERANCE_VOXELS = 1.5

# Before that it was this near in front. A sensor that enters a room stands behind the walls that
# were seen from the room before, and its rays come from there.
_FRONT_VOXELS = 2.0

# Rays step by the distance that the map has stored, and half a voxel at least. Near walls that are
# not met head-on the steps are short. Rays that have not arrived after this number of steps pierce
# nothing.
_STEPS = 48


def find_piercing(config: Config, grid: Grid, rays: Rays) -> jax.Array:
    """Finds the rays that go through a surface of the map before they end.

    Args:
        config: The map's configuration.
        grid: The grid before the cloud is fused.
        rays: The cloud, or some rays of it.

    Returns:
        (N,) bool. Surfaces that are new themselves do not count: they may have moved on.
    """
    derived, size = grid.derived, config.voxel_size
    sdf, shape = derived.sdf.ravel(), config.grid_shape
    tolerance = _TOLERANCE_VOXELS * size + 3 * rays.sigma
    reach = rays.free_ranges - jnp.where(rays.ends, tolerance, 0)

    def advance(
        _: jax.Array, carry: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        along, met, in_front = carry
        points = rays.sensor_world + along[:, None] * rays.directions_world
        index, _, inside = geometry.voxel_of(config, points)
        voxel = geometry.flat_index(shape, split(index))
        here = jnp.where(inside, sdf[voxel].astype(jnp.float32), config.distance_horizon)
        behind = in_front & inside & (along < reach) & (here < -_BEHIND_VOXELS * size)
        met = jnp.where((met < 0) & behind, voxel, met)
        in_front = jnp.where(here > 0, here < _FRONT_VOXELS * size, in_front)
        step = jnp.maximum(jnp.abs(here) - 0.5 * size, 0.5 * size)
        return along + step, met, in_front

    count = rays.in_range.shape[0]
    start = (
        jnp.full(count, config.min_range, jnp.float32),
        jnp.full(count, -1, jnp.int32),
        jnp.zeros(count, bool),
    )
    start = varying_like(start, sdf, rays)
    _, met, _ = jax.lax.fori_loop(0, _STEPS, advance, start, unroll=rounds_per_step(_STEPS))
    x, y, z = jnp.unravel_index(jnp.maximum(met, 0), shape)
    patch = lookup.patch_voxel(config, derived, (x, y, z))
    new = grid.evidence.change.ravel()[patch] > 0
    return rays.in_range & (met >= 0) & ~new
