"""Derivatives of functions of points, for a whole batch at once."""

from __future__ import annotations

from collections.abc import Callable

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


def least(values: jax.Array) -> jax.Array:
    """Minimum along the last axis, with a derivative that holds however it is compiled.

    That of `jnp.min` asks which of the values equal the least. A compiler may compute the values
    again for that, rounded in another way; then none is equal, and the derivative is 0.

    Args:
        values: (..., N), N > 0.

    Returns:
        (...). Of several that are equal, the derivative is the first's.
    """
    chosen = jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1)[..., None]
    return jnp.sum(jnp.where(chosen, values, 0), axis=-1)
