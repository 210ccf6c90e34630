"""What the network is trained on: points with signed distances."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


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
    rank = jnp.cumsum(mask.ravel().astype(jnp.int32))
    total = rank[-1]
    chosen = jax.random.randint(key, (count,), 0, jnp.maximum(total, 1))
    index = jnp.searchsorted(rank, chosen + 1, method="scan_unrolled")
    return jnp.minimum(index, mask.size - 1).astype(jnp.int32), total > 0
