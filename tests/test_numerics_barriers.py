"""Barriers change no value and no derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.numerics.barriers import compute_once, differentiate_once


def plain(tree):
    return tree


def volume(barrier, point):
    """A function of which one part does not depend on the point."""
    x, y, z, c = barrier((point[0], point[1] ** 2, jnp.sin(point[2]), jnp.float32(3)))
    return c * x * y * z + y**3


POINT = jnp.array([0.3, -0.7, 1.1])


@pytest.mark.parametrize("barrier", [compute_once, differentiate_once])
@pytest.mark.parametrize(
    "derive",
    [
        jax.grad,
        jax.jacfwd,
        jax.hessian,
        lambda f: jax.jacrev(jax.jacfwd(f)),
        lambda f: jax.jacfwd(jax.hessian(f)),
        lambda f: jax.grad(jax.checkpoint(f)),
        lambda f: jax.jit(jax.grad(f)),
        lambda f: lambda p: jax.vmap(jax.grad(f))(jnp.stack([p, 2 * p])),
    ],
)
def test_derivatives_are_those_without_a_barrier(barrier, derive):
    found = derive(lambda point: volume(barrier, point))(POINT)
    np.testing.assert_allclose(found, derive(lambda p: volume(plain, p))(POINT), rtol=1e-6)


def test_values_are_the_same_arrays():
    assert differentiate_once((POINT, None))[0] is POINT
