"""Vectors as three arrays, one per component.

A last axis of three keeps XLA from using a CPU's vector instructions where each of many points has
vectors of its own. The nearest patches of 102,400 points then take three times as long.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

Vector = tuple[jax.Array, jax.Array, jax.Array]


def split(vectors: jax.Array) -> Vector:
    """Splits (..., 3) vectors into components."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def join(vector: Vector) -> jax.Array:
    """Joins components to (..., 3) vectors."""
    return jnp.stack(vector, axis=-1)


def each(function: Callable[..., jax.Array], *vectors: Any) -> Vector:
    """Applies a function to the components of vectors, one component at a time."""
    x, y, z = map(function, *vectors)
    return x, y, z


def take(table: Any, rows: jax.Array, first: int = 0) -> Vector:
    """Gathers vectors from the rows of a table (N, M), from column `first` on.

    Args:
        table: Fewer than 2^31 numbers; floats become float32, integers int32. A table in one of
            our kernels (`point_kernel`) gathers in its own way.
        rows: Row indices, (...).
        first: Column of the first component.

    Returns:
        The components, (...) each.
    """
    if hasattr(table, "gather"):
        return table.gather(rows, first)
    floats = jnp.issubdtype(table.dtype, jnp.floating)
    dtype = jnp.float32 if floats else jnp.int32
    # One index per number: a pair takes twice as long on a CPU. Unsigned: no check for negative
    # indices.
    flat, start = table.ravel(), rows.astype(jnp.uint32) * table.shape[1] + first
    x, y, z = (flat[start + k].astype(dtype) for k in range(3))
    return x, y, z


def dot(first: Vector, second: Vector) -> jax.Array:
    """Computes scalar products."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


def cross(first: Vector, second: Vector) -> Vector:
    """Computes vector products."""
    return (
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    )


def unit(vector: Vector) -> Vector:
    """Scales vectors to length 1; those shorter than 1e-6 keep less."""
    norm = jnp.maximum(length(vector), 1e-6)
    return each(lambda v: v / norm, vector)


def length(vector: Vector) -> jax.Array:
    """Computes lengths, with gradient 0 instead of NaN at 0."""
    square = dot(vector, vector)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
