"""Queries: defined everywhere, differentiable, equal for one point and for many."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, CONFIG, ask

import hiosdf_jax as hio
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.grid import lookup
from hiosdf_jax._src.state.pytrees import FRONTIER_STEPS, surface_of

network_sdf = jax.jit(blend.network_sdf)


@jax.jit
def grid_sdf(grid, points):
    return lookup.grid_sdf(CONFIG, surface_of(grid), points)


# A network of two layers: its derivatives go through more than one sine.
DEEP = dataclasses.replace(CONFIG, hidden_width=32, hidden_layers=2)

CORNER = np.array(BOUNDS[1], np.float32)

# Shapes that several tests share, to share compilations.
SHAPE = (2, 3, 4, 3)
MANY = 2000


@pytest.fixture(scope="module")
def field():
    """Without updates it is smooth: the network answers alone."""
    return hio.snapshot(hio.init(DEEP, jax.random.key(3)))


def points_around(count, spread=4.0):
    return np.random.default_rng(0).uniform(-spread, spread, (count, 3)).astype(np.float32)


def test_shapes_and_batch_equals_scalar(field):
    points = points_around(24)
    together = hio.query(field, points.reshape(SHAPE))
    assert together.sdf.shape == (2, 3, 4)
    assert together.grad.shape == (2, 3, 4, 3)
    assert together.observed.shape == (2, 3, 4)
    for k, point in enumerate(points):
        alone = hio.query(field, point)
        np.testing.assert_allclose(alone.sdf, together.sdf.ravel()[k], atol=1e-5)
        np.testing.assert_allclose(alone.grad, together.grad.reshape(-1, 3)[k], atol=1e-4)
    mapped = jax.vmap(lambda p: hio.sdf(field, p))(points)
    np.testing.assert_allclose(mapped, together.sdf.ravel(), atol=1e-5)


@pytest.mark.parametrize("rows", [32_769, 40_000])
def test_a_large_batch_equals_small_ones_at_sizes_that_xla_has_miscompiled(field, rows):
    points = points_around(rows)
    chunks = np.resize(points, (20, MANY, 3))
    parts = [hio.sdf_and_grad(field, chunk) for chunk in chunks]
    value, gradient = (np.concatenate(part)[:rows] for part in zip(*parts, strict=True))
    together = hio.sdf_and_grad(field, points)
    np.testing.assert_allclose(together[0], value, atol=1e-5)
    np.testing.assert_allclose(together[1], gradient, atol=1e-4)
    inside = jax.jit(lambda field, points: hio.sdf_and_grad(field, points))(field, points)
    np.testing.assert_allclose(inside[0], value, atol=1e-5)
    np.testing.assert_allclose(inside[1], gradient, atol=1e-4)
    values = jax.jit(jax.vmap(lambda p: hio.sdf(field, p)))(points)
    np.testing.assert_allclose(values, value, atol=1e-5)


def test_gradient_equals_finite_differences_inside_and_outside(field):
    points = points_around(MANY, 2.0)
    inside = np.all((points > BOUNDS[0]) & (points < BOUNDS[1]), axis=1)
    assert 50 < inside.sum() < MANY - 50
    step = 2e-3
    _, gradient = hio.sdf_and_grad(field, points)
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        slope = (hio.sdf(field, points + shift) - hio.sdf(field, points - shift)) / (2 * step)
        # A point that crosses a face of the box within the step has no derivative.
        low, high = np.array(BOUNDS)
        away = np.all(np.minimum(abs(points - low), abs(points - high)) > 2 * step, axis=1)
        np.testing.assert_allclose(gradient[away, axis], slope[away], atol=5e-3)


def test_outside_the_distance_to_the_box_is_added(field):
    beyond = CORNER + np.array([3.0, 4.0, 0.0], np.float32)
    np.testing.assert_allclose(hio.sdf(field, beyond), hio.sdf(field, CORNER) + 5.0, rtol=1e-5)
    _, gradient = hio.sdf_and_grad(field, beyond)
    np.testing.assert_allclose(gradient[:2], [0.6, 0.8], atol=1e-5)


def test_extreme_points_give_finite_answers(field):
    extremes = np.array(
        [
            [3e38, -3e38, 3e38],
            [1e30, 0, 0],
            [np.inf, 0, -np.inf],
            [1e-40, -1e-40, 0],
            [0, 0, 0],
            BOUNDS[0],
            BOUNDS[1],
            [1e-6 + 1.2, 1.0, 0.8],
            [np.nan, 0, 0],
        ],
        np.float32,
    )
    extremes = np.resize(extremes, SHAPE)
    answer = hio.query(field, extremes)
    for array in (answer.sdf, answer.grad, answer.frontier, answer.lower):
        assert np.isfinite(np.asarray(array)).all()
    assert not np.asarray(answer.observed).any()
    solid = hio.query(field, extremes, unknown="obstacle")
    assert np.isfinite(np.asarray(solid.grad)).all()


@pytest.mark.parametrize("unknown", ["network", "obstacle"])
def test_a_point_with_a_nan_is_not_safe(field, unknown):
    lost = np.array([[np.nan, 0, 0], [np.nan, np.nan, np.inf], [0, 0, np.nan]], np.float32)
    lost = np.resize(lost, SHAPE)
    for source in (field, hio.bake(field, 0.2)):
        answer = hio.query(source, lost, unknown=unknown)
        assert (np.asarray(answer.sdf) < -1e29).all() and np.isfinite(answer.grad).all()
        np.testing.assert_array_equal(hio.sdf(source, lost, unknown=unknown), answer.sdf)
        assert (np.asarray(answer.lower) < -1e29).all()
        assert (np.asarray(answer.frontier) < -1e29).all()


def test_on_the_faces_of_the_box_the_gradient_is_the_one_just_inside(field):
    face, inside = np.array([1.2, -0.5, 0.3]), np.array([1.1999, -0.5, 0.3])
    np.testing.assert_allclose(
        hio.sdf_and_grad(field, face)[1], hio.sdf_and_grad(field, inside)[1], atol=2e-2
    )


def test_forward_mode_and_second_derivatives(field):
    points, toward = points_around(MANY, 0.9), np.full((MANY, 3), 0.5, np.float32)
    value, slope = jax.jvp(lambda p: hio.sdf(field, p), (points,), (toward,))
    exact, gradient = hio.sdf_and_grad(field, points)
    np.testing.assert_allclose(value, exact, atol=1e-5)
    np.testing.assert_allclose(slope, np.sum(gradient * toward, axis=-1), atol=1e-4)
    hessian = jax.hessian(lambda p: hio.sdf(field, p))(points[0])
    step = 1e-2 * np.eye(3, dtype=np.float32)
    shifted = np.resize([points[0] + step, points[0] - step], points.shape)
    high, low = np.asarray(hio.sdf_and_grad(field, shifted)[1])[:6].reshape(2, 3, 3)
    np.testing.assert_allclose(hessian, (high - low) / 2e-2, atol=0.05)


def test_outside_the_distance_to_the_box_is_subtracted_from_lower(field):
    beyond = CORNER + np.array([3.0, 4.0, 0.0], np.float32)
    low, far = hio.query(field, CORNER).lower, hio.query(field, beyond).lower
    np.testing.assert_allclose(far, low - 5.0, rtol=1e-5)


def test_the_map_is_a_traced_argument():
    traces = []

    @jax.jit
    def cost(field, points):
        traces.append(1)
        return jnp.sum(jax.nn.relu(0.3 - hio.sdf(field, points)))

    points = points_around(10, 1.0)
    costs = {float(cost(hio.init(CONFIG, jax.random.key(k)), points)) for k in range(4)}
    assert len(costs) == 4
    assert len(traces) == 1


def test_queries_are_differentiable_by_the_weights(field):
    gradient = jax.grad(lambda f: jnp.sum(hio.sdf(f, points_around(5))), allow_int=True)(field)
    norms = [float(jnp.linalg.norm(leaf)) for leaf in jax.tree.leaves(gradient.params)]
    assert all(np.isfinite(norms))
    assert max(norms) > 0


def test_points_outside_have_not_been_seen(room_map):
    outside = np.array([[1.3, 0, 0], [0, 0, -5.0], [3e38, 0, 0]], np.float32)
    answer = ask(room_map, outside)
    assert not answer.observed.any()
    assert np.all(answer.frontier[:2] <= [-0.1, -4.2])
    assert np.isfinite(answer.frontier).all()


def test_unseen_space_is_an_obstacle_on_request(room_map):
    points = np.random.default_rng(2).uniform(-1.4, 1.4, (2000, 3)).astype(np.float32)
    plain, solid = hio.query(room_map, points), hio.query(room_map, points, unknown="obstacle")
    # Up to 20 cm deep the grid decides, from 40 cm on the frontier; beyond the bounds as at them.
    inside = np.clip(points, *BOUNDS)
    grid = np.asarray(grid_sdf(room_map.grid, inside), np.float64)
    network = np.asarray(network_sdf(hio.snapshot(room_map), inside), np.float64)
    limit = np.clip(np.abs(grid) - 0.02, 0, 0.1)
    near = grid + 0.1 * np.clip(network - grid, -limit, limit)
    far = np.clip((np.abs(grid) - 0.8) / 0.2, 0, 1)
    there = np.asarray(hio.query(room_map, inside).frontier, np.float64)
    value = near + far * (network - near)
    value += np.clip((-there - 0.2) / 0.2, 0, 1) * np.maximum(there - value, 0)
    value -= np.linalg.norm(points - inside, axis=1)
    expected = np.minimum(value, plain.frontier)
    # From 0 to 40 cm deep in unseen space the frontier takes over: its gradient leads out.
    frontier = np.asarray(plain.frontier, np.float64)
    deep = np.clip(-frontier / 0.4, 0, 1)
    assert min(np.mean(deep == 0), np.mean((deep > 0) & (deep < 1)), np.mean(deep == 1)) > 0.05
    expected = (1 - deep) * expected + deep * frontier
    np.testing.assert_allclose(solid.sdf, expected, atol=1e-5)
    assert (np.asarray(solid.sdf)[frontier <= 0] <= 0).all()
    assert (np.asarray(solid.sdf)[~np.asarray(solid.observed)] < 0.01).all()
    assert 0.2 < np.mean(np.asarray(plain.sdf) > plain.frontier) < 0.98
    np.testing.assert_array_equal(solid.frontier, plain.frontier)
    np.testing.assert_array_equal(solid.lower, plain.lower)
    np.testing.assert_allclose(hio.sdf(room_map, points, unknown="obstacle"), solid.sdf, atol=1e-6)
    # Where the frontier is nearer than the surface, the gradient is that of the frontier.
    step = 1e-3
    unseen_nearer = np.asarray(plain.frontier) < value - 0.05
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        high = hio.sdf(room_map, points + shift, unknown="obstacle")
        low = hio.sdf(room_map, points - shift, unknown="obstacle")
        slope = np.asarray(high - low) / (2 * step)
        agrees = np.abs(slope - np.asarray(solid.grad)[:, axis]) < 0.02
        assert agrees[unseen_nearer].mean() > 0.95  # not at faces of cells
        assert agrees[deep == 1].mean() > 0.95


def test_deep_in_unseen_space_only_the_frontier_counts(room_map):
    """Another network changes the answer in observed space, and none deep in unseen space."""
    points = np.random.default_rng(2).uniform(-1.4, 1.4, (2000, 3)).astype(np.float32)
    other = room_map.replace(network=hio.init(CONFIG, jax.random.key(9)).network)
    mine, others = (hio.query(state, points, unknown="obstacle") for state in (room_map, other))
    deep = np.asarray(mine.frontier) <= -0.4
    assert deep.mean() > 0.1
    np.testing.assert_allclose(mine.sdf[deep], mine.frontier[deep], atol=1e-6)
    np.testing.assert_array_equal(others.sdf[deep], mine.sdf[deep])
    np.testing.assert_allclose(others.grad[deep], mine.grad[deep], atol=1e-6)
    assert np.abs(np.asarray(others.sdf) - mine.sdf)[~deep].max() > 0.01


def test_the_lower_bound_of_unseen_space_is_at_most_the_frontier(room_map):
    points = np.random.default_rng(3).uniform(-1.4, 1.4, (2000, 3)).astype(np.float32)
    answer = hio.query(room_map, points)
    unseen = np.asarray(answer.frontier) <= 0
    assert 0.2 < unseen.mean() < 0.9
    lower, frontier = np.asarray(answer.lower), np.asarray(answer.frontier)
    assert (lower[unseen] <= frontier[unseen] + 1e-6).all()
    assert (lower[unseen] < 0).all()
    # A map that trusts itself blindly is bounded by the frontier alone, but only there.
    trusting = room_map.replace(optimism=jnp.float32(-100))
    blind = np.asarray(hio.query(trusting, points).lower)
    np.testing.assert_allclose(blind[unseen], frontier[unseen], atol=1e-6)
    assert (blind[~unseen] > frontier[~unseen]).all()


def test_the_lower_bound_is_negative_outside_a_box_that_is_seen_up_to_its_faces(room_map):
    derived = room_map.grid.derived
    seen = jnp.full_like(derived.frontier_steps, FRONTIER_STEPS)
    grid = room_map.grid.replace(derived=derived.replace(frontier_steps=seen))
    state = room_map.replace(grid=grid, optimism=jnp.float32(-100))
    points = np.random.default_rng(4).uniform(-1.6, 1.6, (2000, 3)).astype(np.float32)
    beyond = np.linalg.norm(points - np.clip(points, *BOUNDS), axis=1)
    for field in (state, hio.bake(state, 0.1)):
        lower = np.asarray(hio.query(field, points).lower)
        assert (lower[beyond > 0] <= -beyond[beyond > 0] + 1e-6).all()
        assert (lower[beyond == 0] > 0).mean() > 0.5


def test_the_lower_bound_of_a_baked_field_is_negative_where_it_has_seen_nothing(room_map):
    trusting = room_map.replace(optimism=jnp.float32(-100))
    points = np.random.default_rng(3).uniform(*BOUNDS, (2000, 3)).astype(np.float32)
    answer = hio.query(hio.bake(trusting, 0.1), points)
    unseen = ~np.asarray(answer.observed)
    assert 0.1 < unseen.mean() < 0.99
    assert (np.asarray(answer.lower)[unseen] <= answer.frontier[unseen] + 1e-6).all()
    assert (np.asarray(answer.lower)[~unseen] > answer.frontier[~unseen]).all()


def test_just_outside_the_box_an_obstacle_leads_back(room_map):
    points = np.random.default_rng(5).uniform(-1.3, 1.3, (2000, 3)).astype(np.float32)
    away = points - np.clip(points, *BOUNDS)
    beyond = np.linalg.norm(away, axis=1)
    near = (beyond > 0) & (beyond < 0.05)
    assert near.sum() > 50
    _, gradient = hio.sdf_and_grad(room_map, points, unknown="obstacle")
    outward = np.sum(away * gradient, axis=1)[near] / beyond[near]
    assert (outward < 0).mean() > 0.9


def test_another_policy_is_refused_by_name(room_map):
    for function in (hio.sdf, hio.sdf_and_grad, hio.query):
        with pytest.raises(ValueError, match="unknown is 'free', expected 'network' or 'obstacle'"):
            function(room_map, np.zeros(3), unknown="free")
