"""The True elements of a mask by their number: the 0th, the 1st and so on in raveled order.

`jax.numpy.nonzero` scatters every element of the mask into `size` counters. On a GPU most of them
contend for the same one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

_WORD = 32  # bits


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
    mask = mask.ravel()
    bits = jnp.pad(mask, (0, -mask.size % _WORD)).reshape(-1, _WORD).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(_WORD, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)
    return RankedMask(words, jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32)))


def indices_of_true(mask: RankedMask, number: jax.Array) -> jax.Array:
    """Finds True elements by their number.

    Args:
        mask: The mask.
        number: Numbers from 0 to the total less 1, (N,) int32.

    Returns:
        Indices into the raveled mask, (N,) int32; undefined for other numbers.
    """
    words, rank = mask
    # On a GPU the unrolled steps are one kernel; on a CPU each is compiled by itself.
    method = "scan" if jax.default_backend() == "cpu" else "scan_unrolled"
    row = jnp.searchsorted(rank, number + 1, method=method)
    row = jnp.minimum(row, words.size - 1).astype(jnp.int32)
    before = jnp.where(row > 0, rank[row - 1], 0)
    return _WORD * row + _nth_bit(words[row], number - before)


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
