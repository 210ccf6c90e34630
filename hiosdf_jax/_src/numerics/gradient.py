"""Derivatives of functions of points, for a whole batch at once."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp


def value_and_gradient(
    function: Callable[[jax.Array], jax.Array], points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates a function and its gradient with one vector-Jacobian product for the whole batch.

    Args:
        function: Maps (..., n) to (...); each value depends on its own row only.
        points: (..., n).

    Returns:
        The values (...) and their gradients (..., n).
    """
    value, pull = jax.vjp(function, points)
    return value, pull(jnp.ones_like(value))[0]


def least(values: jax.Array) -> jax.Array:
    """Computes the minimum along the last axis, with a derivative that is safe to compile.

    The derivative of `jnp.min` compares the values with the minimum. XLA may recompute the values
    with other rounding. Then none is equal, and the derivative is 0.

    Args:
        values: (..., N), N > 0.

    Returns:
        (...); the derivative of the first of several equal values.
    """
    chosen = jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1)[..., None]
    return jnp.sum(jnp.where(chosen, values, 0), axis=-1)
