"""Masks over the leading axes of arrays, and their True elements by number, in raveled order.

Running sums and bisection serve to find them, and others that draw rows.

`jax.numpy.nonzero` scatters every element of the mask into `size` counters. On a GPU most of them
contend for the same one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.barriers import compute_once, hold
from hiosdf_jax._src.numerics.modes import varying_like

WORD = 32  # bits

# On a CPU, XLA makes nine kernels of `cumsum`, which take 0.1 s to compile, and two of a loop that
# adds each number log2(N) times. For 50,000 numbers this loop takes 0.3 instead of 0.1 ms.
_MOST_DOUBLED = 2**16


def where_leading(mask: jax.Array, values: jax.Array, others: jax.Array | float) -> jax.Array:
    """Selects from `values` where a mask over their leading axes is True, else from `others`.

    Args:
        mask: (...) bool.
        values: (..., *trailing).
        others: Broadcasts against `values`.

    Returns:
        (..., *trailing).
    """
    return jnp.where(mask.reshape(*mask.shape, *[1] * (values.ndim - mask.ndim)), values, others)


class RankedMask(NamedTuple):
    """A mask in words, with running counts.

    Attributes:
        words: The raveled mask, 32 elements per word, lowest bit first, (W,) uint32.
        rank: True elements up to the end of each word, (W,) int32.
    """

    words: jax.Array
    rank: jax.Array

    @property
    def total(self) -> jax.Array:
        """Number of True elements, () int32."""
        return self.rank[-1]


def rank_mask(mask: jax.Array) -> RankedMask:
    """Packs a mask (...), not empty, into words and counts its True elements."""
    return rank_words(pack_mask(mask))


def pack_mask(mask: jax.Array) -> jax.Array:
    """Packs a mask (...), not empty, into words, as in `RankedMask`."""
    # A kernel that sums bits is slow. It must not also compute the mask.
    mask = hold(mask.ravel())
    bits = jnp.pad(mask, (0, -mask.size % WORD)).reshape(-1, WORD).astype(jnp.uint32)
    return jnp.sum(bits << jnp.arange(WORD, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)


def rank_words(words: jax.Array) -> RankedMask:
    """Counts the True elements of a packed mask, or of several, one after the other."""
    return RankedMask(words, running_sum(jax.lax.population_count(words).astype(jnp.int32)))


def running_sum(values: jax.Array) -> jax.Array:
    """Computes the running sum of numbers (N,), not empty, as `jax.numpy.cumsum` does."""
    if jax.default_backend() != "cpu" or values.size > _MOST_DOUBLED:
        return jnp.cumsum(values)
    index = jnp.arange(values.size, dtype=jnp.int32)

    def add_earlier(step: jax.Array, sums: jax.Array) -> jax.Array:
        earlier = index - (jnp.int32(1) << step)
        return sums + jnp.where(earlier >= 0, sums[jnp.maximum(earlier, 0)], 0)

    steps = np.int32((values.size - 1).bit_length())
    return jax.lax.fori_loop(np.int32(0), steps, add_earlier, values)


def indices_of_true(mask: RankedMask, number: jax.Array) -> jax.Array:
    """Finds True elements by their number.

    Args:
        mask: The mask.
        number: Numbers from 0 to the total less 1, (N,) int32.

    Returns:
        Indices into the raveled mask, (N,) int32; undefined for other numbers.
    """
    words, rank = mask
    row = jnp.minimum(count_below(rank, number + 1), words.size - 1)
    before = jnp.where(row > 0, rank[row - 1], 0)
    # Once, and not in each kernel that gathers at these indices.
    return compute_once(WORD * row + _nth_bit(words[row], number - before))


def first_true_indices(mask: jax.Array, count: int) -> jax.Array:
    """Finds the first True elements of a mask.

    Args:
        mask: (...) bool, not empty.
        count: Number of elements to find.

    Returns:
        Indices into the raveled mask, (count,) int32, ascending; the size of the mask where there
        are fewer.
    """
    ranked, number = rank_mask(mask), jnp.arange(count, dtype=jnp.int32)
    return jnp.where(number < ranked.total, indices_of_true(ranked, number), mask.size)


def spread_rows(mask: jax.Array, count: int) -> jax.Array:
    """Selects rows where a mask (N,), not empty, holds, spread evenly over all that do.

    Args:
        mask: (N,) bool.
        count: Rows to select; they repeat where fewer hold.

    Returns:
        (count,) int32. Where no row holds, rows that do not.
    """
    ranked = rank_mask(mask)
    number = jnp.arange(count, dtype=jnp.float32) * (ranked.total / count)
    return jnp.clip(indices_of_true(ranked, number.astype(jnp.int32)), 0, mask.size - 1)


def count_below(ascending: jax.Array, values: jax.Array) -> jax.Array:
    """Counts the elements (M,), M > 0, that are less than each value (N,), by bisection."""
    if jax.default_backend() != "cpu":  # the unrolled steps are one kernel
        return jnp.searchsorted(ascending, values, method="scan_unrolled").astype(jnp.int32)
    size = ascending.size
    steps = size.bit_length()

    def advance(step: jax.Array, below: jax.Array) -> jax.Array:
        more = below + (jnp.int32(1) << (steps - 1 - step))
        is_less = ascending[jnp.minimum(more, size) - 1] < values
        return jnp.where((more <= size) & is_less, more, below)

    start = varying_like(jnp.zeros(values.shape, jnp.int32), ascending, values)
    return jax.lax.fori_loop(np.int32(0), np.int32(steps), advance, start)


def _nth_bit(words: jax.Array, n: jax.Array) -> jax.Array:
    """Finds the position of the n-th set bit of each word (n from 0) by bisection."""
    position = jnp.zeros_like(n)
    for half in (16, 8, 4, 2, 1):
        low = words & jnp.uint32((1 << half) - 1)
        count = jax.lax.population_count(low).astype(n.dtype)
        above = n >= count
        n = jnp.where(above, n - count, n)
        words = jnp.where(above, words >> half, low)
        position = position + jnp.where(above, half, 0)
    return position
