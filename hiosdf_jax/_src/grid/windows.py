"""Windows of the grid in which a cloud can have changed derived quantities."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.rays import HIDDEN_VOXELS, Rays
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.modes import cond

# A cloud that fills less than this share of the range in each direction, such as that of a camera
# or of a sensor in a small room, uses a window that is smaller by the same share.
_SMALL = 0.5


class RayBox(NamedTuple):
    """The axis-aligned box of a cloud's rays.

    Attributes:
        sensor_world: (3,) m.
        low_world: Least corner, (3,) m.
        high_world: Greatest corner, (3,) m.
    """

    sensor_world: jax.Array
    low_world: jax.Array
    high_world: jax.Array


def box_of_rays(rays: Rays) -> RayBox:
    """Finds the box that holds the sensor and the free part of every ray."""
    sensor_world = rays.sensor_world
    ends_world = sensor_world + rays.free_ranges[:, None] * rays.directions_world
    ends_world = jnp.where(rays.in_range[:, None], ends_world, sensor_world)
    low, high = jnp.min(ends_world, axis=0), jnp.max(ends_world, axis=0)
    return RayBox(sensor_world, jnp.minimum(low, sensor_world), jnp.maximum(high, sensor_world))


class Window(NamedTuple):
    """Two nested boxes of voxels: what is read, and the inner part that is written.

    Attributes:
        start: First voxel of what is read.
        shape: Shape of what is read, static.
        inner_start: First voxel of what is written.
        inner_shape: Shape of what is written, static.
    """

    start: geometry.Start
    shape: tuple[int, int, int]
    inner_start: geometry.Start
    inner_shape: tuple[int, int, int]

    @property
    def within(self) -> geometry.Start:
        """First voxel of what is written, relative to `start`."""
        return tuple(a - b for a, b in zip(self.inner_start, self.start, strict=True))


def place_windows(
    config: Config, box: RayBox, horizon_m: float
) -> tuple[Window, Window, jax.Array]:
    """Places the windows in which a quantity of a given horizon is recomputed.

    A voxel can change only within the horizon of new evidence, and depends only on evidence within
    the horizon of itself. The window that is read is therefore one horizon larger.

    Args:
        config: The map's configuration.
        box: The cloud's rays.
        horizon_m: The horizon, m, a static number.

    Returns:
        small: Window around the box of the rays.
        large: Window around the sensor, for rays in any direction.
        fits: () bool, whether the small window suffices.
    """
    hidden_m = HIDDEN_VOXELS * config.voxel_size

    def around(center_world: jax.Array, ray_reach_m: float) -> Window:
        changed_m = ray_reach_m + hidden_m + horizon_m + config.voxel_size
        # Half a voxel more, so that rounding does not shrink the margin around the inner box.
        shape = geometry.window_shape(config, changed_m + horizon_m + config.voxel_size / 2)
        inner_shape = geometry.window_shape(config, changed_m)
        return Window(
            geometry.window_start(config, shape, center_world),
            shape,
            geometry.window_start(config, inner_shape, center_world),
            inner_shape,
        )

    large = around(box.sensor_world, config.max_range)
    small_reach_m = _SMALL * config.max_range
    small = around((box.low_world + box.high_world) / 2, small_reach_m)
    return small, large, jnp.max(box.high_world - box.low_world) <= 2 * small_reach_m


def whole_grid(config: Config) -> Window:
    """Returns the window that reads and writes the whole grid."""
    start = (np.int32(0),) * 3
    return Window(start, config.grid_shape, start, config.grid_shape)


def recompute[T](
    config: Config, box: RayBox, horizon_m: float, function: Callable[[Window], T]
) -> T:
    """Calls a function on the smallest window that holds all that a cloud can have changed.

    Args:
        config: The map's configuration.
        box: The cloud's rays.
        horizon_m: How far evidence reaches, m, a static number.
        function: Recomputes a quantity in a window.

    Returns:
        The function's result.
    """
    small, large, fits = place_windows(config, box, horizon_m)
    if (small.shape, small.inner_shape) == (large.shape, large.inner_shape):
        return compute_once(function(large))
    return cond(fits, lambda: function(small), lambda: function(large))
