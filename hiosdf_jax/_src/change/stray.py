"""Stray returns: outliers that none of the many returns around them agree with."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.vectors import split

# Returns are compared in cells of this many pixels along an edge, 2.8 degrees. A wire of 1 cm at a
# distance of 3 m has 7 % of the returns in its cell.
_CELL_PIXELS = 4

# Returns agree if their ranges fall in the same bin or in adjacent ones. A bin is 6 % wide.
_BINS_PER_E = 16
_BINS = 192
_LEAST_RANGE_M = 0.02

# A return is stray if fewer than these agree, in a cell of at least this many returns. The cells of
# a sparse cloud have fewer, and lose none.
_LEAST_AGREEING = 3
_LEAST_SHARE = 0.03
_LEAST_RETURNS = 40


def find_stray(rays: Rays) -> jax.Array:
    """Returns a mask of the stray returns.

    Args:
        rays: The cloud.

    Returns:
        (N,) bool.
    """
    column, line = directions.pixel_coordinates(split(rays.directions_world))
    cells = -(-directions.EDGE // _CELL_PIXELS)
    cell = (line // _CELL_PIXELS) * cells + column // _CELL_PIXELS
    logarithm = jnp.log(jnp.maximum(rays.free_ranges, _LEAST_RANGE_M) / _LEAST_RANGE_M)
    # A bin beside the first and the last one, so that every bin has two neighbors.
    bin_of = jnp.clip((_BINS_PER_E * logarithm).astype(jnp.int32), 0, _BINS - 1) + 1
    width = _BINS + 2
    target = jnp.where(rays.in_range, cell * width + bin_of, cells**2 * width)
    table = jnp.zeros(cells**2 * width, jnp.int32).at[target].add(1, mode="drop")
    around = table.reshape(-1, width)
    total = jnp.sum(around, axis=1)[cell]
    place = cell * width + bin_of
    agreeing = table[place - 1] + table[place] + table[place + 1] - 1
    needed = jnp.maximum(_LEAST_AGREEING, _LEAST_SHARE * total)
    return rays.in_range & (total >= _LEAST_RETURNS) & (agreeing < needed)
