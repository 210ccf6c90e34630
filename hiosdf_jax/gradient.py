"""Derivatives of functions of points that hold wherever they are compiled.

`jnp.minimum`, `jnp.clip`, `jnp.min` and their like ask, for their derivative, which argument equals
the result. A compiler may compute an argument again for that and round it in another way; then
none is equal, and the derivative is 0. What is here asks which one is smaller: there always is one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def value_and_gradient(
    function: Callable[[jax.Array], jax.Array], points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates a function and its gradient by one backward pass for the whole batch.

    Args:
        function: Maps (..., n) to (...), each value by its own row alone.
        points: (..., n).

    Returns:
        The values (...) and their gradients (..., n).
    """
    value, pull = jax.vjp(function, points)
    return value, pull(jnp.ones_like(value))[0]


def lesser(first: Any, second: Any) -> jax.Array:
    """Elementwise minimum; where both are equal, the derivative is the second's.

    Args:
        first: (...).
        second: (...), of a shape that broadcasts with the first's.

    Returns:
        (...).
    """
    return jnp.where(first < second, first, second)


def greater(first: Any, second: Any) -> jax.Array:
    """Elementwise maximum; where both are equal, the derivative is the second's.

    Args:
        first: (...).
        second: (...), of a shape that broadcasts with the first's.

    Returns:
        (...).
    """
    return jnp.where(first > second, first, second)


def limit(values: jax.Array, low: Any, high: Any) -> jax.Array:
    """Moves values outside an interval to its nearer end; on the ends the derivative is 1.

    Args:
        values: (...); a NaN stays one.
        low: The least that is returned; of a shape that broadcasts with the values'.
        high: The largest.

    Returns:
        (...).
    """
    return jnp.where(values < low, low, jnp.where(values > high, high, values))


def least(values: jax.Array) -> jax.Array:
    """Minimum along the last axis; of several that are equal, the derivative is the first's.

    Args:
        values: (..., N), N > 0.

    Returns:
        (...).
    """
    chosen = jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1)[..., None]
    return jnp.sum(jnp.where(chosen, values, 0), axis=-1)
