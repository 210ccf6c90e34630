"""Voxels and meters: voxel indices, windows of the grid, the eight voxels around a point.

Voxel i covers [i, i + 1) * voxel_size along an axis of the world frame. The grid holds the voxels
from `config.corner_index` on. The voxel of a point therefore does not depend on the bounds, and a
grown map answers bit by bit as before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.numerics.barriers import differentiate_once
from hiosdf_jax._src.numerics.vectors import Vector, each, split

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
    # Compared as floats: a far point would overflow an int32.
    cell = jnp.floor(points) - corner
    inside = jnp.all((cell >= 0) & (cell < shape), axis=-1)
    cell = jnp.clip(cell, 0, shape - 1)
    offset = points - (cell + corner) - 0.5
    return jnp.nan_to_num(cell).astype(jnp.int32), offset, inside


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


def voxel_center(config: Config, index: jax.Array) -> jax.Array:
    """Computes the centers of voxels.

    Args:
        config: The map's configuration.
        index: (..., 3) int32 into the grid.

    Returns:
        (..., 3) m, world frame.
    """
    index_world = index + jnp.asarray(config.corner_index, jnp.int32)
    return (index_world.astype(jnp.float32) + 0.5) * config.voxel_size


def window_centers(config: Config, start: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns the centers of all voxels of a window, (X, Y, Z, 3) m, world frame."""
    index = jnp.stack(jnp.meshgrid(*map(jnp.arange, shape), indexing="ij"), axis=-1)
    return voxel_center(config, start + index)


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
        index: Voxel indices, (8, ...) int32 each; at the border some lie beyond the grid.
        flat: Indices into the raveled grid, (8, ...) int32; the nearest voxel for those beyond.
        inside: The voxel lies in the grid, (8, ...) bool.
        weight: (8, ...), adding up to 1.
    """

    index: Vector
    flat: jax.Array
    inside: jax.Array
    weight: jax.Array


# For each axis, whether a corner is the upper one along it.
_UPPER = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32).T


def corners_of(config: Config, points_world: jax.Array) -> Corners:
    """Finds the eight voxels whose centers surround points.

    Args:
        config: The map's configuration.
        points_world: (..., 3) m, finite, inside the bounds.

    Returns:
        The corners; the first is the lowest along all axes.
    """

    def along(points: jax.Array, first: int, upper: np.ndarray) -> tuple[jax.Array, jax.Array]:
        base = jnp.floor(points)
        fraction = points - base
        upper = upper.reshape(8, *[1] * points.ndim)
        index = (base.astype(jnp.int32) - first) + upper
        return index, jnp.where(upper == 1, fraction, 1 - fraction)

    points = differentiate_once(split(points_world / config.voxel_size - 0.5))
    parts = [along(*axis) for axis in zip(points, config.corner_index, _UPPER, strict=True)]
    index = (parts[0][0], parts[1][0], parts[2][0])
    nearest = each(lambda i, n: jnp.clip(i, 0, n - 1), index, config.grid_shape)
    x, y, z = each(jnp.equal, index, nearest)
    weight = parts[0][1] * parts[1][1] * parts[2][1]
    return Corners(index, flat_index(config.grid_shape, nearest), x & y & z, weight)


def clamp(config: Config, points_world: jax.Array) -> jax.Array:
    """Clamps (..., 3) points, m, to the bounds."""
    low, high = jnp.asarray(config.bounds, points_world.dtype)
    return clip_to_box(points_world, low, high)


def clip_to_box(points: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Clamps (..., 3) points to a box, with the whole gradient on its faces.

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
