"""Costs and constraints for jaxls: values, Jacobians, and a path that is planned with them."""

import git_packages
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import baked, count_traces, half_space
from test_planning_body import chain, exact

from hiosdf_jax import planning

MARGIN = 0.05
NORMAL, OFFSET = np.array([0.6, 0.0, 0.8]), 0.4


@pytest.fixture(autouse=True)
def jaxls(monkeypatch):
    git_packages.install(monkeypatch, "jaxls")
    import jaxls

    return jaxls


@pytest.fixture
def configurations(jaxls):
    class Joints(jaxls.Var, default_factory=lambda: jnp.zeros(3)):
        pass

    q = np.random.default_rng(3).uniform(-2, 2, (5, 3)).astype(np.float32)
    variable = Joints(jnp.arange(5))
    return variable, jaxls.VarValues.make([variable.with_value(q)]), q


def jacobian_of(q):
    step = 1e-6 * np.eye(3)
    sides = [exact(q + e, NORMAL, OFFSET) - exact(q - e, NORMAL, OFFSET) for e in step]
    return np.stack(sides, axis=1) / 2e-6


def test_a_constraint_is_clearance_less_margin(configurations):
    variable, values, q = configurations
    make = planning.jaxls.clearance_constraint(chain, margin_m=MARGIN)
    cost = make(half_space(NORMAL, OFFSET), variable)
    assert (cost.kind, cost.name) == ("constraint_geq_zero", "clearance_constraint")
    residual, jacobian = git_packages.evaluate(cost, values)
    for k in range(5):
        np.testing.assert_allclose(residual[k], exact(q[k], NORMAL, OFFSET) - MARGIN, atol=1e-5)
        np.testing.assert_allclose(jacobian[k], jacobian_of(q[k]), atol=1e-5)


def test_a_cost_is_the_weighted_shortfall(configurations):
    variable, values, q = configurations
    make = planning.jaxls.clearance_cost(chain, margin_m=0.3, weight=7.0)
    cost = make(half_space(NORMAL, OFFSET), variable)
    assert (cost.kind, cost.name) == ("l2_squared", "clearance_cost")
    residual, jacobian = git_packages.evaluate(cost, values)
    short = np.array([0.3 - exact(row, NORMAL, OFFSET) for row in q])
    assert (short > 0).any() and (short < 0).any()
    np.testing.assert_allclose(residual, 7 * np.maximum(short, 0), atol=1e-4)
    expected = np.array([jacobian_of(row) for row in q])
    np.testing.assert_allclose(jacobian, -7 * expected * (short > 0)[..., None], atol=1e-4)


def test_the_map_is_no_argument_of_the_cost(configurations):
    variable, *_ = configurations
    make = planning.jaxls.clearance_constraint(chain, margin_m=MARGIN)
    (leaf,) = jax.tree.leaves(make(half_space(NORMAL, OFFSET), variable))
    assert leaf is variable.id


def test_a_variable_on_a_manifold_has_tangents(jaxls):
    """A heading as a unit vector, one tangent."""

    def turned(value, tangent):
        c, s = jnp.cos(tangent[0]), jnp.sin(tangent[0])
        return jnp.stack([c * value[0] - s * value[1], s * value[0] + c * value[1]])

    class Heading(
        jaxls.Var,
        default_factory=lambda: jnp.array([1.0, 0.0]),
        retract_fn=turned,
        tangent_dim=1,
    ):
        pass

    def tip(heading):
        return 0.5 * jnp.append(heading, 0.0)[None], jnp.array([0.1])

    angles = np.array([0.2, 1.4, -2.0])
    variable = Heading(jnp.arange(3))
    headings = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
    values = jaxls.VarValues.make([variable.with_value(headings)])
    make = planning.jaxls.clearance_constraint(tip, margin_m=0.0)
    residual, jacobian = git_packages.evaluate(make(half_space([1.0, 0, 0], 1.0), variable), values)
    np.testing.assert_allclose(residual[:, 0], 0.5 * np.cos(angles) + 0.9, atol=1e-5)
    np.testing.assert_allclose(jacobian[:, 0, 0], -0.5 * np.sin(angles), atol=1e-5)


def test_paths_around_two_balls_with_one_compilation(jaxls):
    class Waypoint(jaxls.Var, default_factory=lambda: jnp.zeros(3)):
        pass

    @jaxls.Cost.factory
    def step(values, here, there):
        return values[there] - values[here]

    @jaxls.Cost.factory
    def held(values, variable, at):
        return 100 * (values[variable] - at)

    clear = planning.jaxls.clearance_constraint(
        lambda p: (p[None], jnp.array([0.2])), margin_m=MARGIN
    )
    guess = np.linspace([0, 0, 0], [2, 0, 0], 12).astype(np.float32)

    def plan(field, guess):
        path = Waypoint(jnp.arange(12))
        ends = jnp.array([0, 11])
        costs = [
            step(Waypoint(path.id[:-1]), Waypoint(path.id[1:])),
            held(Waypoint(ends), guess[ends]),
            clear(field, path),
        ]
        problem = jaxls.LeastSquaresProblem(costs, [path]).analyze()
        return problem.solve(jaxls.VarValues.make([path.with_value(guess)]))[Waypoint]

    counted, traces = count_traces(plan)
    compiled = jax.jit(counted)
    for side in (-1, 1):
        center = np.array([1.0, 0.1 * side, 0.0])

        def ball(points, center=center):
            return np.linalg.norm(points - center, axis=-1) - 0.3

        way = np.asarray(compiled(baked(ball, [-1, -1.5, -0.1], [3, 1.5, 0.1], 0.1), guess))
        assert ball(guess).min() < 0.2
        assert ball(way).min() > 0.2
        assert np.sign(way[5, 1]) == -side
        np.testing.assert_allclose(way[[0, -1]], guess[[0, -1]], atol=0.01)
    assert len(traces) == 1


def test_bad_numbers_are_refused():
    with pytest.raises(ValueError, match="margin_m"):
        planning.jaxls.clearance_constraint(chain, margin_m=-0.1)
    with pytest.raises(ValueError, match="margin_m"):
        planning.jaxls.clearance_cost(chain, margin_m=0.0)
    with pytest.raises(ValueError, match="weight"):
        planning.jaxls.clearance_cost(chain, margin_m=0.1, weight=0.0)


def test_examples_of_docstrings_run(jaxls):
    field = half_space([0.0, 0.0, 1.0], 0.5)
    scope = {"jax": jax, "jaxls": jaxls, "jnp": jnp, "planning": planning, "field": field}
    exec(git_packages.example_of(planning.jaxls.clearance_constraint), scope)
    assert scope["waypoints_world"].shape == (8, 3)
    exec(git_packages.example_of(planning.jaxls.clearance_cost), scope)
    variable = scope["Waypoint"](jnp.arange(1))
    values = jaxls.VarValues.make([variable.with_value(jnp.array([[0.0, 0.0, -0.4]]))])
    residual, _ = git_packages.evaluate(scope["near"](field, variable), values)
    np.testing.assert_allclose(residual, [[2.5]], atol=1e-4)
