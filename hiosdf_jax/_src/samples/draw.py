"""Training samples: points with signed distances, and uniform draws from a mask."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

_WORD = 32  # bits


class Samples(NamedTuple):
    """Supervision of the network.

    Attributes:
        points_world: (N, 3) m.
        sdf: Signed distances, (N,) m.
        weight: 0 or 1, (N,); samples of weight 0 are padding.
    """

    points_world: jax.Array
    sdf: jax.Array
    weight: jax.Array


def concatenate(*parts: Samples) -> Samples:
    """Concatenates sets of samples."""
    return Samples(*(jnp.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def draw_from_mask(mask: jax.Array, count: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws True elements of a mask uniformly, with replacement.

    The draw depends only on the order of the True elements. False elements, such as the padding of
    a cloud, change nothing.

    Args:
        mask: (...) bool.
        count: Number of elements to draw.
        key: Source of randomness.

    Returns:
        index: Indices into the raveled mask, (count,) int32.
        possible: Whether any element is True, () bool; the indices are undefined otherwise.
    """
    words = _words(mask.ravel())
    rank = jnp.cumsum(jax.lax.population_count(words).astype(jnp.int32))
    total = rank[-1]
    # `randint` has no bias of total / 2^32, and takes three times as long to compile.
    bits = jax.random.bits(key, (count,), jnp.uint32)
    chosen = (bits % jnp.maximum(total, 1).astype(jnp.uint32)).astype(jnp.int32)
    # On a GPU the unrolled steps are one kernel; on a CPU each is compiled by itself.
    method = "scan" if jax.default_backend() == "cpu" else "scan_unrolled"
    row = jnp.searchsorted(rank, chosen + 1, method=method)
    row = jnp.minimum(row, words.size - 1).astype(jnp.int32)
    before = jnp.where(row > 0, rank[row - 1], 0)
    index = _WORD * row + _nth_bit(words[row], chosen - before)
    return jnp.minimum(index, mask.size - 1).astype(jnp.int32), total > 0


def _words(mask: jax.Array) -> jax.Array:
    """Packs (N,) bool into words, lowest bit first, so that sums are over fewer elements."""
    bits = jnp.pad(mask, (0, -mask.size % _WORD)).reshape(-1, _WORD).astype(jnp.uint32)
    return jnp.sum(bits << jnp.arange(_WORD, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)


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
