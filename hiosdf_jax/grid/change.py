"""Where a cloud has changed the evidence: what follows from it is computed again around there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax.config import Config
from hiosdf_jax.grid import geometry, rays
from hiosdf_jax.grid.beams import Beams

# Clouds that fill less than this share of the range in each direction, as those of a camera that
# looks one way or of a sensor in a small room do, are served by a window that is as much smaller.
_SMALL = 0.5


class Change(NamedTuple):
    """The box of a cloud's rays.

    Attributes:
        sensor_world: (3,) m.
        low_world: (3,) m, the corner of least coordinates of the box that holds all rays.
        high_world: (3,) m, the other one.
    """

    sensor_world: jax.Array
    low_world: jax.Array
    high_world: jax.Array


def change_by(beams: Beams) -> Change:
    """Finds the box.

    Args:
        beams: The cloud.

    Returns:
        The change.
    """
    sensor_world = beams.sensor_world
    ends_world = sensor_world + beams.free_ranges[:, None] * beams.directions_world
    ends_world = jnp.where(beams.in_range[:, None], ends_world, sensor_world)
    low, high = jnp.min(ends_world, axis=0), jnp.max(ends_world, axis=0)
    return Change(sensor_world, jnp.minimum(low, sensor_world), jnp.maximum(high, sensor_world))


def recompute[T](
    config: Config,
    change: Change,
    margin: float,
    function: Callable[[jax.Array, float], T],
) -> T:
    """Computes something again where a cloud has changed it, in the smaller window that will do.

    Args:
        config: The map's configuration.
        change: Of the cloud.
        margin: How much farther than the rays the function reads, m.
        function: Takes the middle of the change (3,), m, and the reach of its rays from there
            along each axis, m, a static number.

    Returns:
        What the function returns.
    """
    hidden = rays.HIDDEN_VOXELS * config.voxel_size
    small, large = (share * config.max_range + hidden for share in (_SMALL, 1.0))
    shapes = [geometry.window_shape(config, reach + margin) for reach in (small, large)]
    if shapes[0] == shapes[1]:
        return function(change.sensor_world, large)
    extent = jnp.max(change.high_world - change.low_world)
    middle = (change.low_world + change.high_world) / 2
    return jax.lax.cond(
        extent <= 2 * (small - hidden),
        lambda: function(middle, small),
        lambda: function(change.sensor_world, large),
    )
