"""Training samples: points with signed distances, and uniform draws from a mask."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.numerics.masks import indices_of_true, rank_mask


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
    ranked = rank_mask(mask)
    # `randint` has no bias of total / 2^32, and takes three times as long to compile.
    bits = jax.random.bits(key, (count,), jnp.uint32)
    chosen = (bits % jnp.maximum(ranked.total, 1).astype(jnp.uint32)).astype(jnp.int32)
    index = indices_of_true(ranked, chosen)
    return jnp.minimum(index, mask.size - 1), ranked.total > 0
