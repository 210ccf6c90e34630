"""Derivatives of least and greatest values, and that no derivative rests on two equal floats."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import half_space

import hiosdf_jax as hio
from hiosdf_jax import gradient, planning
from hiosdf_jax.planning.robot import BodyPoses, RobotSpheres

CONFIG = hio.Config.light(((-1.0, -2.0, 0.0), (3.0, 1.0, 2.0)), hidden_width=16, max_points=64)
A = np.array([1.0, 2.0, 3.0, -np.inf], np.float32)
B = np.array([2.0, 2.0, 1.0, 5.0], np.float32)


@pytest.fixture(scope="module")
def field():
    state = hio.init(CONFIG, jax.random.key(0))
    rng = np.random.default_rng(0)
    return hio.snapshot(hio.update(state, rng.uniform(-0.8, 0.8, (64, 3)), np.eye(4)))


def test_lesser_and_greater():
    np.testing.assert_array_equal(gradient.lesser(A, B), np.minimum(A, B))
    np.testing.assert_array_equal(gradient.greater(A, B), np.maximum(A, B))
    for function, of_first in ((gradient.lesser, [1, 0, 0, 1]), (gradient.greater, [0, 0, 1, 0])):
        first, second = jax.vjp(function, A, B)[1](jnp.ones(4))
        np.testing.assert_array_equal(first, of_first)
        np.testing.assert_array_equal(second, 1 - np.array(of_first))


def test_limit():
    values = jnp.array([-2.0, -1.0, 0.5, 1.0, 3.0, jnp.inf, jnp.nan])
    limited, pull = jax.vjp(lambda v: gradient.limit(v, -1, 1.0), values)
    np.testing.assert_array_equal(limited, [-1, -1, 0.5, 1, 1, 1, np.nan])
    np.testing.assert_array_equal(pull(jnp.ones(7))[0][:6], [0, 1, 1, 1, 0, 0])


def test_least():
    values = jnp.array([[3.0, 1.0, 1.0], [jnp.inf, 2.0, 5.0], [-jnp.inf, 0.0, 1.0], [jnp.inf] * 3])
    found, pull = jax.vjp(gradient.least, values)
    np.testing.assert_array_equal(found, [1, 2, -np.inf, np.inf])
    np.testing.assert_array_equal(pull(jnp.ones(4))[0][:3], [[0, 1, 0], [0, 1, 0], [1, 0, 0]])


def equations(jaxpr: Any) -> Iterator[Any]:
    """All equations of a jaxpr and of those in it."""
    for equation in jaxpr.eqns:
        yield equation
        for part in jax.tree.leaves(
            list(equation.params.values()),
            is_leaf=lambda x: isinstance(x, jax.extend.core.ClosedJaxpr | jax.extend.core.Jaxpr),
        ):
            if isinstance(part, jax.extend.core.ClosedJaxpr):
                yield from equations(part.jaxpr)
            elif isinstance(part, jax.extend.core.Jaxpr):
                yield from equations(part)


def float_equalities(function: Any, *arguments: Any) -> int:
    """How often the derivative asks whether two floats are equal."""

    def derivative(*arguments: Any) -> Any:
        value, pull = jax.vjp(function, *arguments)
        return pull(jnp.ones_like(value))

    return sum(
        equation.primitive.name == "eq"
        and all(jnp.issubdtype(v.aval.dtype, jnp.floating) for v in equation.invars)
        and not any(isinstance(v, jax.extend.core.Literal) for v in equation.invars)  # infinities
        for equation in equations(jax.make_jaxpr(derivative)(*arguments).jaxpr)
    )


# An H100 answered a tenth of the points with the gradient 0: the least of eight distances, computed
# twice, was equal to none of them.
@pytest.mark.parametrize("unknown", ["network", "obstacle"])
@pytest.mark.parametrize("kind", ["field", "baked"])
def test_no_query_compares_floats_for_its_derivative(field, kind, unknown):
    asked = field if kind == "field" else hio.bake(field, resolution=0.5)
    points, radii = jnp.zeros((4, 3)), jnp.full(4, 0.1)
    for function in (
        lambda p: hio.sdf(asked, p, unknown),
        lambda p: hio.query(asked, p, unknown).lower,
        lambda p: hio.query(asked, p, unknown).frontier,
        lambda p: planning.sphere_clearance(asked, p, radii, unknown),
        lambda p: planning.swept_clearance(asked, p, p + 1, radii, unknown),
    ):
        assert float_equalities(function, points) == 0


def test_no_cost_compares_floats_for_its_derivative():
    assert float_equalities(lambda d: planning.collision_cost(d, 0.2), jnp.ones(4)) == 0
    assert float_equalities(gradient.least, jnp.ones((2, 3))) == 0
    assert float_equalities(lambda d: jnp.min(d, axis=-1), jnp.ones((2, 3))) > 0  # it is noticed
    assert float_equalities(jax.jit(lambda d: jnp.clip(d, 0, 1)), jnp.ones(4)) > 0


def test_no_derivative_of_a_robots_clearance_compares_floats():
    wall = half_space((1.0, 0.0, 0.0), 0.0)
    spheres = RobotSpheres(
        body=jnp.zeros(2, jnp.int32), centers_body=jnp.zeros((2, 3)), radii=jnp.full(2, 0.1)
    )

    def clearance(position: jax.Array) -> jax.Array:
        return planning.robot_clearance(wall, spheres, BodyPoses(position[None], jnp.eye(3)[None]))

    assert float_equalities(clearance, jnp.ones(3)) == 0
