"""A cloud as an image: how near and how far its rays reach in each direction.

An octahedral map unfolds the sphere of directions into a square, so that a camera and a LiDAR that
looks all around are treated alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.vectors import Vector, split

# Pixels along an edge: 0.7 degrees each.
EDGE = 256

# Pixels without a ray take their neighbors' values up to this far: the rings of a LiDAR are 2
# degrees apart.
_GAP_PIXELS = (1, 2)

# Rays are counted up to this many pixels away, over two or three rings of a LiDAR.
_DENSE_PIXELS = 3
_DENSE_SHARE = 0.6

# Ranges around a pixel are similar up to this ratio. Sparse clouds have few pixels with several
# rays around them, and nothing can be said of them.
_SIMILAR = 1.2
_LEAST_PIXELS = 200

UNKNOWN = -1.0
"""`smoothness` of a cloud that is too sparse for it."""


class RangeImage(NamedTuple):
    """Ranges by direction.

    Attributes:
        nearest: Least range of the rays in each pixel, (P,) m; inf in pixels without rays.
        farthest: Largest range of the rays in each pixel, (P,) m; -1 in pixels without rays.
        row: A ray of the largest range, (P,) int32; -1 in pixels without rays.
    """

    nearest: jax.Array
    farthest: jax.Array
    row: jax.Array


def pixel_of(offset: Vector) -> jax.Array:
    """Finds the pixels of directions.

    Args:
        offset: From the sensor, of any length, (...) each.

    Returns:
        Indices into the raveled image, (...) int32.
    """
    column, line = pixel_coordinates(offset)
    return line * EDGE + column


def pixel_coordinates(offset: Vector) -> tuple[jax.Array, jax.Array]:
    """Finds the columns and lines of directions, (...) int32 each."""
    x, y, z = offset
    norm = jnp.maximum(jnp.abs(x) + jnp.abs(y) + jnp.abs(z), 1e-12)
    x, y = x / norm, y / norm
    folded_x = jnp.where(x < 0, -1.0, 1.0) * (1 - jnp.abs(y))
    folded_y = jnp.where(y < 0, -1.0, 1.0) * (1 - jnp.abs(x))
    x, y = jnp.where(z < 0, folded_x, x), jnp.where(z < 0, folded_y, y)

    def pixel(t: jax.Array) -> jax.Array:
        return jnp.clip(((t + 1) * (EDGE / 2)).astype(jnp.int32), 0, EDGE - 1)

    return pixel(x), pixel(y)


def neighbor_pixels(offset: Vector) -> jax.Array:
    """Finds the 3 x 3 pixels around directions, (..., 9) int32; those off the edge repeat it."""
    column, line = pixel_coordinates(offset)
    step = jnp.arange(-1, 2)
    lines = jnp.clip(line[..., None, None] + step[:, None], 0, EDGE - 1)
    columns = jnp.clip(column[..., None, None] + step, 0, EDGE - 1)
    return (lines * EDGE + columns).reshape(*column.shape, 9)


def range_image(rays: Rays, chosen: jax.Array) -> RangeImage:
    """Makes the image of some rays.

    Args:
        rays: The cloud.
        chosen: Rows to draw, (N,) bool; rows that are not in range are left out.

    Returns:
        The image.
    """
    drawn = chosen & rays.in_range
    pixel = jnp.where(drawn, pixel_of(split(rays.directions_world)), EDGE**2)
    ranges = rays.free_ranges
    nearest = jnp.full(EDGE**2, jnp.inf, jnp.float32).at[pixel].min(ranges, mode="drop")
    farthest = jnp.full(EDGE**2, -1.0, jnp.float32).at[pixel].max(ranges, mode="drop")
    # Rows of equal range are decided by their number: a scatter has no order.
    is_farthest = drawn & (ranges >= farthest[jnp.minimum(pixel, EDGE**2 - 1)])
    number = jnp.where(is_farthest, jnp.arange(ranges.size, dtype=jnp.int32), -1)
    row = jnp.full(EDGE**2, -1, jnp.int32).at[pixel].max(number, mode="drop")
    return RangeImage(nearest, farthest, row)


class View(NamedTuple):
    """A cloud as seen from its sensor.

    Attributes:
        measured: Pixels in which rays ended.
        filled: The same, with pixels between rays filled.
    """

    measured: RangeImage
    filled: RangeImage


def view_of(rays: Rays) -> View:
    """Makes the images of a cloud."""
    measured = range_image(rays, rays.in_range)
    return View(measured, fill_gaps(measured))


def fill_gaps(image: RangeImage) -> RangeImage:
    """Fills pixels between rays with the nearest and the farthest range around them."""
    # The largest is the least with its sign reversed. Pixels without rays: inf, and 1 = -(-1).
    both = jnp.stack([image.nearest, -image.farthest]).reshape(2, EDGE, EDGE)
    for reach in _GAP_PIXELS:
        both = jnp.where(both[1] > 0, _pool(both, jnp.inf, jax.lax.min, reach), both)
    nearest, farthest = both.reshape(2, EDGE**2)
    return RangeImage(nearest, -farthest, image.row)


def spread_nearest(image: RangeImage, measured: RangeImage) -> jax.Array:
    """Spreads the nearest ranges of some rays to pixels where no ray was measured.

    Args:
        image: The image of some rays of a cloud.
        measured: The image of all of them.

    Returns:
        The nearest range, (P,) m; inf where there is none.
    """
    nearest = image.nearest.reshape(EDGE, EDGE)
    unmeasured = (measured.farthest < 0).reshape(EDGE, EDGE)
    for reach in _GAP_PIXELS:
        around = _pool(nearest, jnp.inf, jax.lax.min, reach)
        nearest = jnp.where(unmeasured & jnp.isinf(nearest), around, nearest)
    return nearest.ravel()


def dense_parts(rays: Rays, chosen: jax.Array) -> jax.Array:
    """Finds the pixels where chosen rays are so dense that they show a solid thing.

    Args:
        rays: The cloud.
        chosen: Its rows of interest, (N,) bool.

    Returns:
        (P,) bool: pixels near one around which chosen rays are a large share of all rays. The edge
        of a table, which most rays pass above or below, has none.
    """
    pixel = jnp.where(rays.in_range, pixel_of(split(rays.directions_world)), EDGE**2)

    kinds = jnp.stack([chosen, jnp.ones_like(chosen)]).astype(jnp.float32)
    counts = jnp.zeros((2, EDGE**2), jnp.float32).at[:, pixel].add(kinds, mode="drop")
    ours, all_rays = _pool(counts.reshape(2, EDGE, EDGE), 0.0, jax.lax.add, _DENSE_PIXELS)
    dense = (ours > _DENSE_SHARE * all_rays).astype(jnp.float32)
    return _pool(dense, 0.0, jax.lax.max, _DENSE_PIXELS).ravel() > 0


def smoothness(rays: Rays, chosen: jax.Array) -> jax.Array:
    """Computes how similar the ranges of neighboring rays are.

    Args:
        rays: The cloud.
        chosen: Its rows of interest, (N,) bool.

    Returns:
        Share of the pixels with chosen rays and several ranges in the 3 x 3 pixels around where
        these ranges are within 20 %, () float32; `UNKNOWN` if there are few such pixels.
    """
    if rays.in_range.size < _LEAST_PIXELS:
        return jnp.float32(UNKNOWN)
    image = range_image(rays, rays.in_range)
    both = jnp.stack([image.nearest, -image.farthest]).reshape(2, EDGE, EDGE)
    nearest, farthest = _pool(both, jnp.inf, jax.lax.min, 1).reshape(2, EDGE**2)
    several = (range_image(rays, chosen).farthest > 0) & (-farthest > nearest)
    count = jnp.sum(several)
    share = jnp.sum(several & (-farthest < _SIMILAR * nearest)) / jnp.maximum(count, 1)
    return jnp.where(count >= _LEAST_PIXELS, share, UNKNOWN).astype(jnp.float32)


def _pool(
    values: jax.Array, start: float, function: Callable[..., jax.Array], reach: int
) -> jax.Array:
    """Reduces the square around each pixel of (..., EDGE, EDGE) images, one axis at a time."""
    first = np.asarray(start, values.dtype)  # a float64 under jax_enable_x64 otherwise
    edge = 2 * reach + 1
    others = (1,) * (values.ndim - 2)
    for shape in ((*others, edge, 1), (*others, 1, edge)):
        values = jax.lax.reduce_window(values, first, function, shape, (1,) * values.ndim, "SAME")
    return values
