"""Linear equations of a few unknowns, written out.

On a GPU, a Gauss-Newton step takes 0.7 of the time with it: the solver of a library starts several
kernels for one 6 x 6 matrix.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

# Pivots below this share of the diagonal are rounding errors of float32.
_LEAST_PIVOT = 1e-5


def solve_positive(matrix: jax.Array, value: jax.Array) -> jax.Array:
    """Solves linear equations by an LDL^T factorization.

    Args:
        matrix: Symmetric and positive definite, (..., K, K), K small; its lower half is read.
        value: The right side, (..., K).

    Returns:
        The solution, (..., K).
    """
    size = value.shape[-1]
    lower: dict[tuple[int, int], jax.Array] = {}
    scaled: dict[tuple[int, int], jax.Array] = {}  # lower[i, k] * pivot[k]
    inverse, x = [], []
    for j in range(size):
        pivot = matrix[..., j, j] - sum(scaled[j, k] * lower[j, k] for k in range(j))
        inverse.append(1 / jnp.maximum(pivot, _LEAST_PIVOT * matrix[..., j, j]))
        for i in range(j + 1, size):
            rest = sum(scaled[i, k] * lower[j, k] for k in range(j))
            scaled[i, j] = matrix[..., i, j] - rest
            lower[i, j] = scaled[i, j] * inverse[j]
        x.append(value[..., j] - sum(lower[j, k] * x[k] for k in range(j)))
    for j in reversed(range(size)):
        x[j] = x[j] * inverse[j] - sum(lower[i, j] * x[i] for i in range(j + 1, size))
    return jnp.stack(x, axis=-1)
