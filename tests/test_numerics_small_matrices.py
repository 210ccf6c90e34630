"""Small linear equations and eigenvectors against numpy in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import clear, interpret_point_kernels

from hiosdf_jax._src.numerics.small_matrices import (
    eigenvectors,
    inverse,
    product,
    solve_positive,
)

solve = jax.jit(solve_positive)


def positive(seed, count, size, condition):
    """Symmetric matrices with eigenvalues from 1 to 1 / condition."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(count, size, size)))[0]
    values = np.geomspace(1, 1 / condition, size)
    return basis @ (values[:, None] * np.swapaxes(basis, 1, 2)), rng.normal(size=(count, size))


@pytest.mark.parametrize(("size", "condition"), [(1, 1), (3, 10), (6, 10), (6, 1000)])
def test_solutions_are_those_of_numpy(size, condition):
    matrix, value = positive(size, 300, size, condition)
    matrix, value = matrix.astype(np.float32), value.astype(np.float32)
    expected = np.linalg.solve(matrix.astype(float), value.astype(float)[..., None])[..., 0]
    found = np.asarray(solve(matrix, value))
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert error.max() < 2e-6 * condition
    one = np.stack([solve(m, v) for m, v in zip(matrix[:5], value[:5], strict=True)])
    np.testing.assert_allclose(one, found[:5], rtol=1e-5 * condition, atol=1e-5)


def test_one_matrix_solves_many_right_sides():
    matrix, _ = positive(3, 1, 6, 100)
    values = np.random.default_rng(0).normal(size=(50, 6)).astype(np.float32)
    expected = np.linalg.solve(matrix[0], values.T.astype(float)).T
    np.testing.assert_allclose(solve(matrix[0].astype(np.float32), values), expected, rtol=2e-3)


@pytest.mark.parametrize("shapes", [((3, 3), (3, 3)), ((6, 6), (6,)), ((5, 2, 4), (5, 4, 3))])
def test_products_are_those_of_numpy_in_float64(shapes):
    rng = np.random.default_rng(0)
    first, second = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    expected = first.astype(float) @ second.astype(float)
    np.testing.assert_allclose(product(first, second), expected, atol=2e-6)


def test_a_direction_without_information_stays_finite():
    matrix = np.diag([1.0, 2.0, 1e-30]).astype(np.float32)
    found = np.asarray(solve(matrix, np.array([1.0, 1.0, 0.0], np.float32)))
    np.testing.assert_allclose(found, [1.0, 0.5, 0.0])


def test_directions_without_information_stay_finite():
    """Two returns give a matrix of rank 2, up to rounding; what they say nothing about stays."""
    rng = np.random.default_rng(4)
    slopes = rng.normal(size=(300, 2, 6))
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)  # a diagonal of 1
    matrix = (np.swapaxes(slopes, 1, 2) @ slopes).astype(np.float32)
    exact = rng.normal(size=(300, 2))
    value = np.einsum("nki,nk->ni", slopes, exact).astype(np.float32)
    found = np.asarray(solve(matrix, value))
    # The two equations hold, and no part of the solution is more than their rounding explains.
    np.testing.assert_allclose(np.einsum("nki,ni->nk", slopes, found), exact, atol=0.1)
    assert np.abs(found).max() < 100


def test_the_derivative_is_that_of_the_inverse():
    (matrix,), (value,) = (part.astype(np.float32) for part in positive(9, 1, 6, 5))
    by_value = jax.jacfwd(solve_positive, argnums=1)(matrix, value)
    np.testing.assert_allclose(by_value, np.linalg.inv(matrix.astype(float)), atol=1e-4)
    turned = jax.grad(lambda v: jnp.sum(solve_positive(matrix, v) ** 2))(value)
    exact = 2 * np.linalg.solve(matrix.T, np.linalg.solve(matrix, value))
    np.testing.assert_allclose(turned, exact, rtol=1e-3)


@pytest.fixture(scope="module", params=["library", "kernel"])
def find(request):
    """`eigenvectors` by a library, and by the kernel for GPUs interpreted on a CPU."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "kernel":
            interpret_point_kernels(patch)
        yield jax.jit(lambda matrix: eigenvectors(matrix))  # traced anew for each
    clear()


MATRICES = {
    "condition 1.5": 1e4 * positive(5, 10, 6, 1.5)[0],
    "condition 1e3": 1e4 * positive(5, 10, 6, 1e3)[0],
    "condition 1e6": 1e4 * positive(5, 10, 6, 1e6)[0],
    "zero": np.zeros((6, 6)),
    "unit": np.eye(6),
    "rank 1": np.ones((6, 6)),
    "diagonal": np.diag([3.0, 1, 2, 1, 0, 5]),
    "far apart": np.diag([1e-30, 1e30, 1, 1, 0, 5]) + 1e-20,
    "negative": -np.diag([3.0, 1, 2, 1, 0, 5]) - 1,
}


@pytest.mark.parametrize("kind", MATRICES)
def test_eigenvectors_turn_a_matrix_to_the_eigenvalues_of_numpy(find, kind):
    for matrix in MATRICES[kind].reshape(-1, 6, 6).astype(np.float32):
        basis, exact = np.asarray(find(matrix), float), matrix.astype(float)
        np.testing.assert_allclose(basis.T @ basis, np.eye(6), atol=2e-6)
        expected = np.diag(np.linalg.eigvalsh(exact))
        atol = 2e-6 * np.linalg.norm(exact)
        np.testing.assert_allclose(basis.T @ exact @ basis, expected, atol=atol)


def test_eigenvectors_of_a_batch_are_those_one_by_one(find):
    matrices = positive(6, 5, 6, 100)[0].astype(np.float32)
    together = np.asarray(jax.vmap(find)(matrices))
    one_by_one = np.stack([find(matrix) for matrix in matrices])
    np.testing.assert_allclose(together, one_by_one, atol=1e-5)


@pytest.mark.parametrize("condition", [1, 1e2, 1e4])
def test_inverses_are_those_of_numpy(condition):
    for matrix in positive(7, 20, 6, condition)[0].astype(np.float32):
        expected = np.linalg.inv(matrix.astype(float))
        error = np.linalg.norm(np.asarray(inverse(matrix)) - expected) / np.linalg.norm(expected)
        assert error < 3e-6 * condition


@pytest.mark.parametrize(("condition", "factor"), [(1e6, 1.1), (1e7, 2)])
def test_the_variance_of_the_weakest_direction_is_not_limited(condition, factor):
    """What is hardly known must not seem to be known."""
    matrices = positive(8, 100, 6, condition)[0]
    size = 1 / np.sqrt(np.einsum("nii->ni", matrices))
    for matrix in (size[:, :, None] * matrices * size[:, None]).astype(np.float32):
        values, vectors = np.linalg.eigh(matrix.astype(float))
        weakest = vectors[:, 0]
        found = weakest @ np.asarray(inverse(matrix), float) @ weakest
        assert 1 / factor < found * values[0] < factor


def test_the_inverse_of_a_singular_matrix_is_finite_and_large():
    vectors = np.linalg.qr(np.random.default_rng(8).normal(size=(6, 6)))[0]
    values = np.array([1, 1, 1, 1, 1, 0.0])
    matrix = (vectors * values @ vectors.T).astype(np.float32)
    found = np.asarray(inverse(matrix), float)
    assert np.isfinite(found).all()
    assert np.linalg.norm(found @ vectors[:, 5]) > 1e6
