"""The least of several values, and derivatives that do not depend on equal floats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import equalities_with_least

import hiosdf_jax as hio
from hiosdf_jax import planning
from hiosdf_jax._src.numerics.gradient import least, value_and_gradient

CONFIG = hio.Config.light(((-1.0, -2.0, 0.0), (3.0, 1.0, 2.0)), hidden_width=16, max_points=64)


@pytest.fixture(scope="module")
def field():
    return hio.snapshot(hio.init(CONFIG, jax.random.key(0)))


def test_least():
    values = jnp.array([[3.0, 1.0, 1.0], [jnp.inf, 2.0, 5.0], [-jnp.inf, 0.0, 1.0]])
    found, slopes = value_and_gradient(least, values)
    np.testing.assert_array_equal(found, [1, 2, -np.inf])
    np.testing.assert_array_equal(slopes, [[0, 1, 0], [0, 1, 0], [1, 0, 0]])
    assert least(jnp.array([jnp.inf, jnp.inf])) == jnp.inf
    assert jnp.isnan(least(jnp.array([1.0, jnp.nan, 0.0])))


@pytest.mark.parametrize("unknown", ["network", "obstacle"])
@pytest.mark.parametrize("kind", ["field", "baked"])
def test_no_derivative_of_a_query_depends_on_equal_floats(field, kind, unknown):
    asked = field if kind == "field" else hio.bake(field, resolution=0.5)
    points, radii = jnp.zeros((4, 3)), jnp.full(4, 0.1)
    for function in (
        lambda p: hio.sdf(asked, p, unknown),
        lambda p: hio.sdf_and_grad(asked, p, unknown)[1],
        lambda p: hio.query(asked, p, unknown).lower,
        lambda p: hio.query(asked, p, unknown).frontier,
        lambda p: planning.sphere_clearance(asked, p, radii, unknown),
        lambda p: planning.swept_clearance(asked, p, p + 1, radii, unknown),
    ):
        assert equalities_with_least(function, points) == 0


def test_such_a_derivative_would_be_found():
    if not equalities_with_least(lambda d: jnp.min(d, axis=-1), jnp.ones((2, 3))):
        pytest.skip("this version of jax compares in another way")
    assert equalities_with_least(jax.jit(lambda d: jnp.max(jnp.sin(d), axis=0)), jnp.ones((2, 3)))
    assert equalities_with_least(least, jnp.ones((2, 3))) == 0
