"""Products, linear equations and eigenvectors of small matrices, written out.

XLA makes one kernel of them and what surrounds them. A library starts a kernel for each product,
several for one system of linear equations, and fifty for eigenvectors.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.point_kernel import by_points

# Pivots below this share of the diagonal are rounding errors of float32 in sums of many returns.
# Below the second one, half a unit in the last place, they are so even in an exact matrix.
_LEAST_PIVOT = 1e-5
_ROUNDING = 6e-8

# Float32 needs four or five sweeps over matrices (6, 6), and never more than six.
_SWEEPS = 6


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


def solve_positive(
    matrix: jax.Array, value: jax.Array, least_pivot: float = _LEAST_PIVOT
) -> jax.Array:
    """Solves linear equations by an LDL^T factorization.

    Args:
        matrix: Symmetric and positive definite, (..., K, K), K small; its lower half is read.
        value: The right side, (..., K); its leading axes and those of `matrix` are broadcast.
        least_pivot: Pivots are at least this share of the diagonal.

    Returns:
        The solution, (..., K).
    """
    entries = [[matrix[..., i, j] for j in range(i + 1)] for i in range(value.shape[-1])]
    parts = [value[..., i] for i in range(value.shape[-1])]
    return jnp.stack(solve_entries(entries, parts, least_pivot), axis=-1)


def inverse(matrix: jax.Array) -> jax.Array:
    """Inverts a symmetric, positive definite matrix (K, K), K small; its lower half is read.

    The inverse of a singular matrix is finite, and about 1e7 times that of its largest eigenvalue.
    """
    columns = jnp.eye(len(matrix), dtype=matrix.dtype)
    return solve_positive(matrix, columns, _ROUNDING)


def eigenvectors(matrix: jax.Array) -> jax.Array:
    """Computes the eigenvectors of a symmetric matrix (K, K), K small.

    On a Hopper GPU one kernel does it, by Jacobi's rotations (Golub and Van Loan, Matrix
    Computations, section 8.5). Elsewhere a library does.

    Returns:
        Unit vectors as columns, (K, K), that of the least eigenvalue first.
    """
    if not devices.has_kernels():
        return jnp.linalg.eigh(matrix)[1]
    size = len(matrix)
    entries = matrix.reshape(1, size * size)
    return by_points(_eigenvectors_at, size, (), entries, least=1).reshape(size, size)


def _eigenvectors_at(size: int, tables: Any, entries: Any) -> tuple[jax.Array, ...]:
    """Computes `eigenvectors` of matrices whose K * K numbers are arrays (...) of their own."""
    one = jnp.ones_like(entries[0])
    unit = tuple(one if k % (size + 1) == 0 else 0 * one for k in range(size * size))

    def rows(entries: Sequence[jax.Array]) -> list[list[jax.Array]]:
        return [list(entries[k : k + size]) for k in range(0, size * size, size)]

    def sweep(_: Any, carry: Any) -> Any:
        matrix, vectors = map(rows, carry)
        for p, q in itertools.combinations(range(size), 2):
            _rotate(matrix, vectors, p, q)
        return tuple(itertools.chain(*matrix)), tuple(itertools.chain(*vectors))

    matrix, vectors = jax.lax.fori_loop(0, _SWEEPS, sweep, (tuple(entries), unit))
    values = matrix[:: size + 1]

    def rank(i: int) -> jax.Array:
        """Counts the smaller eigenvalues; of equal ones the first counts as the smaller one."""
        less = [(v <= values[i]) if j < i else (v < values[i]) for j, v in enumerate(values)]
        return reduce(jnp.add, [part.astype(jnp.int32) for part in less])

    ranks = [rank(i) for i in range(size)]

    def chosen(row: Sequence[jax.Array], number: int) -> jax.Array:
        parts = [jnp.where(ranks[i] == number, row[i], 0) for i in range(size)]
        return reduce(jnp.add, parts)

    return tuple(chosen(row, number) for row in rows(vectors) for number in range(size))


def _rotate(matrix: list[list[jax.Array]], vectors: list[list[jax.Array]], p: int, q: int) -> None:
    """Turns two axes of a symmetric matrix so that one entry and its mirror image become zero."""
    mixed = matrix[p][q]
    some = mixed != 0
    ratio = (matrix[q][q] - matrix[p][p]) / jnp.where(some, 2 * mixed, 1)
    tangent = jnp.where(ratio < 0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.sqrt(1 + ratio * ratio))
    tangent = jnp.where(some, tangent, 0)
    cosine = jax.lax.rsqrt(1 + tangent * tangent)
    sine = tangent * cosine

    def turn(row: list[jax.Array]) -> None:
        row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]

    for k, row in enumerate(matrix):
        if k not in (p, q):
            turn(row)
            matrix[p][k], matrix[q][k] = row[p], row[q]
    matrix[p][p] -= tangent * mixed
    matrix[q][q] += tangent * mixed
    matrix[p][q] = matrix[q][p] = jnp.zeros_like(mixed)
    for row in vectors:
        turn(row)


def solve_entries(
    matrix: Sequence[Sequence[Any]], value: Sequence[Any], least_pivot: float = _LEAST_PIVOT
) -> list[Any]:
    """Solves linear equations whose numbers are arrays of their own; see `solve_positive`.

    Args:
        matrix: The lower half, row by row: K rows of 1 to K arrays (...).
        value: The right side, K arrays (...).
        least_pivot: Pivots are at least this share of the diagonal.

    Returns:
        The solution, K arrays (...).
    """
    size = len(value)
    lower: dict[tuple[int, int], jax.Array] = {}
    scaled: dict[tuple[int, int], jax.Array] = {}  # lower[i, k] * pivot[k]
    reciprocal, x = [], []  # of the pivots
    for j in range(size):
        pivot = matrix[j][j] - sum(scaled[j, k] * lower[j, k] for k in range(j))
        reciprocal.append(1 / jnp.maximum(pivot, least_pivot * matrix[j][j]))
        for i in range(j + 1, size):
            rest = sum(scaled[i, k] * lower[j, k] for k in range(j))
            scaled[i, j] = matrix[i][j] - rest
            lower[i, j] = scaled[i, j] * reciprocal[j]
        x.append(value[j] - sum(lower[j, k] * x[k] for k in range(j)))
    for j in reversed(range(size)):
        x[j] = x[j] * reciprocal[j] - sum(lower[i, j] * x[i] for i in range(j + 1, size))
    return x
