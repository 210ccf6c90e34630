"""Products and linear equations of small matrices, written out.

XLA makes one kernel of them and what surrounds them. A library starts a kernel for each product,
and several for one system of linear equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

# Pivots below this share of the diagonal are rounding errors of float32.
_LEAST_PIVOT = 1e-5


def product(first: jax.Array, second: jax.Array) -> jax.Array:
    """Multiplies matrices in float32, where a GPU's library may round to fewer bits.

    Args:
        first: (..., M, K), K small.
        second: Matrices (..., K, N), or one vector (K,).

    Returns:
        (..., M, N), or (..., M) for a vector.
    """
    if second.ndim == 1:
        return jnp.sum(first * second, axis=-1)
    return jnp.sum(first[..., :, :, None] * second[..., None, :, :], axis=-2)


def solve_positive(matrix: jax.Array, value: jax.Array) -> jax.Array:
    """Solves linear equations by an LDL^T factorization.

    Args:
        matrix: Symmetric and positive definite, (..., K, K), K small; its lower half is read.
        value: The right side, (..., K); its leading axes and those of `matrix` are broadcast.

    Returns:
        The solution, (..., K).
    """
    entries = [[matrix[..., i, j] for j in range(i + 1)] for i in range(value.shape[-1])]
    parts = [value[..., i] for i in range(value.shape[-1])]
    return jnp.stack(solve_entries(entries, parts), axis=-1)


def solve_entries(matrix: Sequence[Sequence[Any]], value: Sequence[Any]) -> list[Any]:
    """Solves linear equations whose numbers are arrays of their own; see `solve_positive`.

    Args:
        matrix: The lower half, row by row: K rows of 1 to K arrays (...).
        value: The right side, K arrays (...).

    Returns:
        The solution, K arrays (...).
    """
    size = len(value)
    lower: dict[tuple[int, int], jax.Array] = {}
    scaled: dict[tuple[int, int], jax.Array] = {}  # lower[i, k] * pivot[k]
    inverse, x = [], []
    for j in range(size):
        pivot = matrix[j][j] - sum(scaled[j, k] * lower[j, k] for k in range(j))
        inverse.append(1 / jnp.maximum(pivot, _LEAST_PIVOT * matrix[j][j]))
        for i in range(j + 1, size):
            rest = sum(scaled[i, k] * lower[j, k] for k in range(j))
            scaled[i, j] = matrix[i][j] - rest
            lower[i, j] = scaled[i, j] * inverse[j]
        x.append(value[j] - sum(lower[j, k] * x[k] for k in range(j)))
    for j in reversed(range(size)):
        x[j] = x[j] * inverse[j] - sum(lower[i, j] * x[i] for i in range(j + 1, size))
    return x
