"""What the network is trained on: points with signed distances."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

_WORD = 32  # bits


class Samples(NamedTuple):
    """Supervision of the network.

    Attributes:
        points_world: (N, 3) m.
        sdf: (N,) m.
        weight: (N,) 0 or 1; samples of weight 0 are padding.
    """

    points_world: jax.Array
    sdf: jax.Array
    weight: jax.Array


def concatenate(*parts: Samples) -> Samples:
    """Joins sets of samples."""
    return Samples(*(jnp.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def draw_from_mask(mask: jax.Array, count: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws elements of a mask uniformly, with replacement.

    What is drawn depends on the order of the True elements alone: False ones in between or at the
    end, the padding of a cloud, change nothing.

    Args:
        mask: (...) bool.
        count: How many to draw.
        key: Source of randomness.

    Returns:
        index: (count,) int32 into the raveled mask.
        possible: () bool, whether any element is True; if not, the indices mean nothing.
    """
    words = _words(mask.ravel())
    rank = jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32))
    total = rank[-1]
    chosen = jax.random.randint(key, (count,), 0, jnp.maximum(total, 1))
    row = jnp.searchsorted(rank, chosen + 1, method="scan_unrolled")
    row = jnp.minimum(row, words.size - 1).astype(jnp.int32)
    before = jnp.where(row > 0, rank[row - 1], 0)
    index = _WORD * row + _nth_bit(words[row], chosen - before)
    return jnp.minimum(index, mask.size - 1).astype(jnp.int32), total > 0


def _words(mask: jax.Array) -> jax.Array:
    """Packs (N,) bool into words, the first one in the lowest bit: sums over them are shorter."""
    bits = jnp.pad(mask, (0, -mask.size % _WORD)).reshape(-1, _WORD).astype(jnp.uint32)
    return jnp.sum(bits << jnp.arange(_WORD, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)


def _nth_bit(words: jax.Array, n: jax.Array) -> jax.Array:
    """Position of the n-th (from 0) bit that is set in each word, by halves."""
    position = jnp.zeros_like(n)
    for half in (16, 8, 4, 2, 1):
        low = words & jnp.uint32((1 << half) - 1)
        count = jax.lax.population_count(low).astype(n.dtype)
        above = n >= count
        n = jnp.where(above, n - count, n)
        words = jnp.where(above, words >> half, low)
        position = position + jnp.where(above, half, 0)
    return position
