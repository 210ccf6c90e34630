"""Training samples: points with signed distances, and uniform draws from masks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.masks import WORD, indices_of_true, pack_mask, rank_words


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


def draw_words(key: jax.Array, *shapes: tuple[int, ...]) -> list[jax.Array]:
    """Draws random words by one call of JAX's generator, which is ten kernels on a CPU.

    Args:
        key: Source of randomness.
        shapes: Shapes of the arrays to draw.

    Returns:
        Arrays of uint32, one per shape.
    """
    sizes = [math.prod(shape) for shape in shapes]
    words = jax.random.bits(key, (sum(sizes),), jnp.uint32)
    parts = jnp.split(words, np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def uniform(words: jax.Array) -> jax.Array:
    """Turns random words into uniform numbers in [0, 1), float32."""
    return (words >> 8).astype(jnp.float32) * 2.0**-24


def normal(words: jax.Array) -> jax.Array:
    """Turns random words into normal numbers of variance 1, float32."""
    # In (-1, 1), without the ends: their normal numbers would be infinite.
    signed = ((words >> 8).astype(jnp.float32) - (2.0**23 - 0.5)) * 2.0**-23
    return math.sqrt(2) * jax.lax.erf_inv(signed)


def draw_from_masks(
    masks: Sequence[jax.Array], words: Sequence[jax.Array]
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Draws True elements of masks uniformly, with replacement.

    A draw depends only on the order of the True elements. False elements, such as the padding of a
    cloud, change nothing. All masks are searched at once, which compiles faster than one by one.

    Args:
        masks: (...) bool each.
        words: Random words, (N,) uint32 per mask, one for each draw.

    Returns:
        indices: Indices into the raveled masks, (N,) int32 each.
        possible: Whether any element of the mask is True, () bool each; the indices are undefined
            otherwise.
    """
    packed = [pack_mask(mask) for mask in masks]
    ends = np.cumsum([part.size for part in packed])
    ranked = rank_words(jnp.concatenate(packed))
    counts = [jnp.zeros((), jnp.int32), *(ranked.rank[end - 1] for end in ends)]
    totals = [after - before for before, after in itertools.pairwise(counts)]
    # `randint` has no bias of total / 2^32, and takes three times as long to compile.
    numbers = [
        (bits % jnp.maximum(total, 1).astype(jnp.uint32)).astype(jnp.int32) + before
        for bits, total, before in zip(words, totals, counts[:-1], strict=True)
    ]
    found = indices_of_true(ranked, jnp.concatenate(numbers))
    parts = jnp.split(found, np.cumsum([bits.size for bits in words])[:-1])
    firsts = [0, *(WORD * end for end in ends.tolist()[:-1])]  # each mask's first element
    indices = [
        jnp.clip(part - first, 0, mask.size - 1)
        for part, first, mask in zip(parts, firsts, masks, strict=True)
    ]
    return indices, [total > 0 for total in totals]


def draw_from_mask(mask: jax.Array, words: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws as `draw_from_masks` from one mask (...) by words (N,): indices (N,), possible ()."""
    (index,), (possible,) = draw_from_masks([mask], [words])
    return index, possible
