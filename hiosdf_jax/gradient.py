"""Values and gradients of a function of points, for a whole batch at once."""

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
