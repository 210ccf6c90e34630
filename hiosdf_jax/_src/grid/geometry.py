"""Voxels and meters: voxel indices, windows of the grid, the eight voxels around a point.

Voxel i covers [i, i + 1) * voxel_size along an axis of the world frame. The grid holds the voxels
from `config.corner_index` on. The voxel of a point therefore does not depend on the bounds, and a
grown map answers bit for bit as before.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.barriers import differentiate_once
from hiosdf_jax._src.numerics.vectors import Vector, each

type Start = tuple[jax.Array | np.int32, ...]
"""First voxel of a window: an int32 scalar for each axis, a constant where only one fits."""


def voxel_of(config: Config, points_world: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the voxels that contain points.

    Args:
        config: The map's configuration.
        points_world: (..., 3) m.

    Returns:
        index: (..., 3) int32 into the grid; the nearest voxel for points outside.
        offset: (..., 3) from the voxel's center, voxels, in [-0.5, 0.5) for points inside.
        inside: (...) bool; False for a point with a NaN.
    """
    points = points_world / config.voxel_size  # voxels
    corner = jnp.asarray(config.corner_index, points.dtype)
    shape = jnp.asarray(config.grid_shape, points.dtype)
    cell, inside = _nearest_cell(points, corner, shape)
    offset = points - (cell + corner) - 0.5
    return jnp.nan_to_num(cell).astype(jnp.int32), offset, jnp.all(inside, axis=-1)


def voxel_around(config: Config, point: Vector) -> tuple[Vector, jax.Array]:
    """Finds the voxels that contain finite points, as `voxel_of` does.

    Args:
        config: The map's configuration.
        point: (...) m each.

    Returns:
        Voxel indices, (...) int32 each, of the nearest voxel for points outside; and whether the
        point is inside the grid, (...) bool.
    """

    def along(p: jax.Array, first: int, count: int) -> tuple[jax.Array, jax.Array]:
        return _nearest_cell(p / config.voxel_size, first, count)

    x, y, z = map(along, point, config.corner_index, config.grid_shape)
    index = each(lambda cell: cell.astype(jnp.int32), (x[0], y[0], z[0]))
    return index, x[1] & y[1] & z[1]


def _nearest_cell(points: jax.Array, corner: Any, shape: Any) -> tuple[jax.Array, jax.Array]:
    """Finds cells of a grid, and whether the points, in voxels, are inside it along each axis."""
    # Compared as floats: a far point would overflow an int32.
    cell = jnp.floor(points) - corner
    return jnp.clip(cell, 0, shape - 1), (cell >= 0) & (cell < shape)


def voxel_of_window(
    config: Config, start: jax.Array, shape: tuple[int, ...], points_world: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the voxels of a window that contain points.

    Args:
        config: The map's configuration.
        start: First voxel of the window, (3,) int32.
        shape: Shape of the window.
        points_world: (..., 3) m.

    Returns:
        As `voxel_of`, relative to the window; indices of points outside of it are undefined.
    """
    index, offset, inside = voxel_of(config, points_world)
    index = index - start
    within = jnp.all((index >= 0) & (index < jnp.asarray(shape, jnp.int32)), axis=-1)
    return index, offset, inside & within


def window_voxel_around(
    config: Config, start: jax.Array, shape: tuple[int, ...], point: Vector
) -> tuple[Vector, jax.Array]:
    """Finds the voxels of a window that contain points, as `voxel_of_window` does.

    Args:
        config: The map's configuration.
        start: First voxel of the window, (3,) int32.
        shape: Shape of the window.
        point: (...) m each.

    Returns:
        Voxel indices relative to the window, (...) int32 each, undefined for points outside of it;
        and whether the point is inside, (...) bool, False for a point with a NaN.
    """
    index, inside = voxel_around(config, point)
    index = each(jnp.subtract, index, start)
    x, y, z = each(lambda i, count: (i >= 0) & (i < count), index, shape)
    return index, inside & x & y & z


def voxel_center(config: Config, index: jax.Array) -> jax.Array:
    """Computes the centers of voxels.

    Args:
        config: The map's configuration.
        index: (..., 3) int32 into the grid.

    Returns:
        (..., 3) m, world frame.
    """
    return center_along(config, index, jnp.asarray(config.corner_index, jnp.int32))


def center_along(config: Config, index: jax.Array, corner: Any) -> jax.Array:
    """Computes a coordinate of voxels' centers from their indices and `corner_index` there, m."""
    return ((index + corner).astype(jnp.float32) + 0.5) * config.voxel_size


def window_centers(config: Config, start: jax.Array, shape: tuple[int, ...]) -> Vector:
    """Returns the centers of all voxels of a window, m, world frame.

    Args:
        config: The map's configuration.
        start: First voxel of the window, (3,) int32.
        shape: Shape of the window.

    Returns:
        (X, 1, 1), (1, Y, 1) and (1, 1, Z): each coordinate depends on one index.
    """

    def along(axis: int) -> jax.Array:
        kept = [count if k == axis else 1 for k, count in enumerate(shape)]
        index = start[axis] + jax.lax.broadcasted_iota(jnp.int32, kept, axis)
        return center_along(config, index, config.corner_index[axis])

    return each(along, range(3))


def flat_index(shape: tuple[int, ...], index: Vector) -> jax.Array:
    """Converts indices (...) into an array of this shape to indices into the raveled array."""
    return (index[0] * shape[1] + index[1]) * shape[2] + index[2]


def unflatten(shape: tuple[int, ...], flat: jax.Array) -> Vector:
    """Converts indices into a raveled array of this shape, >= 0, to indices (...) into the array.

    `jnp.unravel_index` also takes negative indices, which costs five operations more per axis.
    """
    _, across, deep = map(np.int32, shape)  # int32 also where 64-bit numbers are enabled
    rows, z = jax.lax.div(flat, deep), jax.lax.rem(flat, deep)
    return jax.lax.div(rows, across), jax.lax.rem(rows, across), z


class Corners(NamedTuple):
    """The eight voxels whose centers surround points, with trilinear interpolation weights.

    The eight come first: a CPU cannot use its vector instructions for sums over a short last axis.

    Attributes:
        lowest: Indices of the lowest of the eight along all axes, (...) int32 each.
        index: Voxel indices, (8, ...) int32 each; at the border some lie beyond the grid.
        flat: Indices into the raveled grid, (8, ...) int32; the nearest voxel for those beyond.
        inside: The voxel lies in the grid, (8, ...) bool.
        weight: (8, ...), adding up to 1.
    """

    lowest: Vector
    index: Vector
    flat: jax.Array
    inside: jax.Array
    weight: jax.Array


def corners_of(config: Config, point: Vector) -> Corners:
    """Finds the eight voxels whose centers surround points.

    Args:
        config: The map's configuration.
        point: (...) m each, finite, inside the bounds.

    Returns:
        The corners.
    """
    point = differentiate_once(each(lambda p: p / config.voxel_size - 0.5, point))
    shape = 8, *[1] * point[0].ndim
    number: Any = np.arange(8, dtype=np.int32).reshape(shape)
    if devices.has_kernels():  # see `by_points`; elsewhere XLA folds what constants determine
        number = jax.lax.broadcasted_iota(jnp.int32, shape, 0)

    upper = each(lambda bit: (number >> bit) & 1, (2, 1, 0))
    base = each(jnp.floor, point)
    lowest = each(lambda b, first: b.astype(jnp.int32) - first, base, config.corner_index)
    index = each(jnp.add, lowest, upper)
    nearest = each(lambda i, n: jnp.clip(i, 0, n - 1), index, config.grid_shape)
    x, y, z = each(jnp.equal, index, nearest)

    def share(p: jax.Array, base: jax.Array, upper: jax.Array) -> jax.Array:
        # Without a selection, which would double the sums of the derivative.
        fraction, upper = p - base, upper.astype(np.float32)
        return (1 - upper) + (2 * upper - 1) * fraction

    shares = each(share, point, base, upper)
    flat = flat_index(config.grid_shape, nearest)
    return Corners(lowest, index, flat, x & y & z, shares[0] * shares[1] * shares[2])


def clamp(config: Config, point: Vector) -> Vector:
    """Clamps points, (...) m each, to the bounds."""
    return each(clip_to_box, point, *(map(np.float32, corner) for corner in config.bounds))


def clip_to_box(points: jax.Array, low: Any, high: Any) -> jax.Array:
    """Clamps points, or one of their components, to a box, with the whole gradient on its faces.

    (`jnp.clip` halves the gradient there.)
    """
    return jnp.where(points < low, low, jnp.where(points > high, high, points))


def window_shape(config: Config, reach: float) -> tuple[int, int, int]:
    """Computes the shape of the window within `reach` (m) of a point along each axis."""
    span = 2 * math.ceil(reach / config.voxel_size) + 1
    x, y, z = config.grid_shape
    return (min(x, span), min(y, span), min(z, span))


def window_start(config: Config, shape: tuple[int, int, int], center_world: jax.Array) -> Start:
    """Places a window around a point, moved to lie inside the grid.

    Args:
        config: The map's configuration.
        shape: Shape of the window, no larger than the grid.
        center_world: (3,) m.

    Returns:
        Its first voxel.
    """
    index, _, _ = voxel_of(config, center_world)
    room = np.subtract(config.grid_shape, shape).astype(np.int32)
    start = jnp.clip(index - np.asarray(shape, np.int32) // 2, 0, room)
    # A constant where there is no choice: `jax.vmap` would make a gather of a read at `start`.
    x, y, z = (start[axis] if room[axis] else np.int32(0) for axis in range(3))
    return x, y, z


def read_window(array: jax.Array, start: Start, shape: tuple[int, int, int]) -> jax.Array:
    """Reads a window of a grid array; axes after the third are read whole."""
    rest = array.shape[3:]
    return jax.lax.dynamic_slice(array, _full_start(start, rest), (*shape, *rest))


def write_window(array: jax.Array, start: Start, values: jax.Array) -> jax.Array:
    """Writes a window of a grid array."""
    return jax.lax.dynamic_update_slice(array, values, _full_start(start, array.shape[3:]))


def _full_start(start: Start, rest: tuple[int, ...]) -> Start:
    # All int32: a plain 0 would be an int64 under jax_enable_x64.
    return (*start, *(np.int32(0) for _ in rest))
