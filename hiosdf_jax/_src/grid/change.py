"""Where a cloud has changed the evidence: what follows from it is computed again around there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import carving, geometry
from hiosdf_jax._src.grid.rays import Beams

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


class Window(NamedTuple):
    """Two boxes of voxels, one in the other: what is read, and what can have changed.

    Attributes:
        start: First voxel of what is read, three int32 scalars.
        shape: Of what is read, static.
        inner_start: First voxel of what can have changed.
        inner_shape: Of what can have changed, static.
    """

    start: tuple[jax.Array, ...]
    shape: tuple[int, int, int]
    inner_start: tuple[jax.Array, ...]
    inner_shape: tuple[int, int, int]

    @property
    def within(self) -> tuple[jax.Array, ...]:
        """First voxel of what can have changed, counted from that of what is read."""
        return tuple(a - b for a, b in zip(self.inner_start, self.start, strict=True))


def place_windows(
    config: Config, change: Change, horizon_m: float
) -> tuple[Window, Window, jax.Array]:
    """Places the windows in which something that reaches as far as a horizon is computed again.

    A voxel changes only within the horizon of new evidence, and what decides on it lies within the
    horizon of it: the window read is that much larger than what can have changed.

    Args:
        config: The map's configuration.
        change: Of the cloud.
        horizon_m: The horizon, a static number.

    Returns:
        small: Around the box of the rays.
        large: Around the sensor, for rays of any direction.
        fits: () bool, whether the small one will do.
    """
    hidden_m = carving.HIDDEN_VOXELS * config.voxel_size

    def around(center_world: jax.Array, ray_reach_m: float) -> Window:
        changed_m = ray_reach_m + hidden_m + horizon_m + config.voxel_size
        # Half a voxel more, so that rounding takes none from the margin around what is written.
        shape = geometry.window_shape(config, changed_m + horizon_m + config.voxel_size / 2)
        inner_shape = geometry.window_shape(config, changed_m)
        return Window(
            geometry.window_start(config, shape, center_world),
            shape,
            geometry.window_start(config, inner_shape, center_world),
            inner_shape,
        )

    large = around(change.sensor_world, config.max_range)
    small_reach_m = _SMALL * config.max_range
    small = around((change.low_world + change.high_world) / 2, small_reach_m)
    return small, large, jnp.max(change.high_world - change.low_world) <= 2 * small_reach_m


def recompute[T](
    config: Config, change: Change, horizon_m: float, function: Callable[[Window], T]
) -> T:
    """Computes something again where a cloud has changed it, in the smaller window that will do.

    Args:
        config: The map's configuration.
        change: Of the cloud.
        horizon_m: How far evidence reaches, a static number.
        function: Computes it in a window.

    Returns:
        What the function returns.
    """
    small, large, fits = place_windows(config, change, horizon_m)
    if (small.shape, small.inner_shape) == (large.shape, large.inner_shape):
        return function(large)
    return jax.lax.cond(fits, lambda: function(small), lambda: function(large))
