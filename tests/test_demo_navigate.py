"""The robot's motion, its guard, and its ways over the plane."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hiosdf_jax._src.state import Baked

pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from hiosdf_jax._src.demo import navigate

ROBOT = navigate.Robot(heights=(0.3, 0.5))
BOUNDS = ((0.0, 0.0, 0.0), (4.0, 3.0, 1.0))


def baked(sdf, frontier=None, resolution=0.1):
    """Samples functions of points (..., 3) over BOUNDS."""
    low, high = np.array(BOUNDS)
    shape = np.rint((high - low) / resolution).astype(int) + 1
    points = low + resolution * np.indices(shape).transpose(1, 2, 3, 0)
    values = np.asarray(sdf(points), np.float32)
    seen = np.full(shape, 1.0) if frontier is None else frontier(points)
    return Baked(
        corner_world=jnp.asarray(low, jnp.float32),
        resolution=jnp.float32(resolution),
        sdf=jnp.asarray(values),
        frontier=jnp.asarray(seen, jnp.float32),
        lower=jnp.asarray(values),
        updates=jnp.int32(1),
        stamp=jnp.float32(0),
    )


def wall_at(x):
    return lambda points: x - points[..., 0]


def wall_with_door(points):
    """A wall 0.2 m thick at x = 2 with a door over y in (2.0, 2.8)."""
    x, y = points[..., 0] - 2.0, points[..., 1]

    def post(centre, half):
        dx, dy = np.abs(x) - 0.1, np.abs(y - centre) - half
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        return outside + np.minimum(np.maximum(dx, dy), 0)

    return np.minimum(post(0.5, 1.5), post(3.8, 1.0))


# --- motion ---


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-3, 3),
    st.floats(0, 0.6),
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
    st.floats(-5, 5),
)
def test_motion_is_that_of_a_finely_integrated_unicycle(yaw, speed, rate, push, twist):
    got = np.asarray(
        navigate.motion(ROBOT, jnp.array([1.0, 2.0, yaw, speed, rate]), jnp.array([push, twist]))
    )[-1]
    x, y, fine = 1.0, 2.0, 2000
    dt = ROBOT.step / fine
    push, twist = np.clip(push, -1, 1), np.clip(twist, -4, 4)
    for _ in range(fine):
        speed = min(max(speed + dt * push, 0), 0.6)
        rate = min(max(rate + dt * twist, -1.5), 1.5)
        yaw += dt * rate
        x, y = x + dt * speed * math.cos(yaw), y + dt * speed * math.sin(yaw)
    np.testing.assert_allclose(got[3:], [speed, rate], atol=1e-3)
    # Four substeps are a first-order scheme: an error of half a substep's acceleration.
    np.testing.assert_allclose(got[:3], [x, y, yaw], atol=0.03)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 0.6), st.floats(-1.5, 1.5))
def test_braking_stops_the_robot_in_the_distance_that_physics_allows(speed, rate):
    state = jnp.array([0.0, 0.0, 0.3, speed, rate])
    for _ in range(math.ceil(0.6 / (1.0 * ROBOT.step))):
        state = navigate.motion(ROBOT, state, navigate.braking(ROBOT, state))[-1]
    np.testing.assert_allclose(state[3:], 0, atol=1e-6)
    assert float(jnp.hypot(*state[:2])) <= speed**2 / 2 + 0.5 * speed * ROBOT.step + 1e-5


def test_clearance_is_the_least_over_the_body():
    field = baked(lambda p: np.minimum(p[..., 2], 2.5 - p[..., 0]))
    states = jnp.array([[1.0, 1.0, 0, 0, 0], [2.1, 1.0, 0, 0, 0]])
    got = navigate.clearance(ROBOT, field, states, "network")
    np.testing.assert_allclose(got, [0.3 - 0.2, 0.3 - 0.2], atol=1e-5)
    raised = navigate.Robot(heights=(0.9,))
    got = navigate.clearance(raised, field, states, "network")
    np.testing.assert_allclose(got, [0.7, 0.2], atol=1e-5)


# --- the guard ---


@functools.cache
def driver_with(unknown):
    return navigate.make_driver(ROBOT, unknown, jax.random.key(0), samples=64, horizon=8)


def drive_at(field, unknown, steps=40, reward=1.0):
    """Drives along x, drawn by a reward for it; the states and what the guard refused."""
    driver = driver_with(unknown)
    plane = navigate.lay_plane(BOUNDS, 0.1)
    task = navigate.Task(
        field=field,
        to_go=jnp.asarray(reward * (4 - plane.centres()[..., 0]), jnp.float32),
        corner=jnp.asarray(plane.corner, jnp.float32),
        spacing=jnp.float32(plane.spacing),
        heading=jnp.array([1.0, 0.0]),
    )
    plan, state = driver.plan, jnp.array([0.5, 1.5, 0.0, 0.0, 0.0])
    states, refusals = [], []
    for _ in range(steps):
        control, plan, refused = driver.step(plan, state, task)
        states.append(np.asarray(navigate.motion(ROBOT, state, control)))
        state = jnp.asarray(states[-1][-1])
        refusals.append(bool(refused))
    return np.concatenate(states), refusals


def test_the_guard_stops_a_robot_that_wants_through_a_wall():
    # The reward dwarfs all cost of collision: only the guard is left.
    states, refusals = drive_at(baked(wall_at(2.5)), "network", reward=1e4)
    assert any(refusals)
    furthest = states[:, 0].max() + ROBOT.radius
    assert 2.2 < furthest <= 2.5 - ROBOT.margin + 1e-4


@pytest.mark.parametrize(("unknown", "enters"), [("obstacle", False), ("network", True)])
def test_space_that_was_not_seen_is_entered_under_one_policy_only(unknown, enters):
    open_space = baked(lambda p: np.full(p.shape[:-1], 2.0), lambda p: 2.0 - p[..., 0])
    states, _ = drive_at(open_space, unknown, reward=1e4 if not enters else 1.0)
    furthest = states[:, 0].max() + ROBOT.radius
    assert (furthest > 2.5) if enters else (1.7 < furthest <= 2.0 - ROBOT.margin + 1e-4)


def test_the_guard_lets_a_robot_leave_a_place_that_is_too_near():
    # The wall turns out to be where the robot's margin is, behind it.
    field = baked(lambda p: p[..., 0] - 0.28)
    states, _ = drive_at(field, "network")
    assert states[-1, 0] > 1.5


# --- ways over the plane ---


def test_cells_and_points_belong_together():
    plane = navigate.lay_plane(BOUNDS, 0.1)
    assert plane.shape == (40, 30)
    centres = plane.centres()
    np.testing.assert_allclose(centres[0, 0], [0.05, 0.05])
    np.testing.assert_allclose(centres[-1, -1], [3.95, 2.95])
    assert plane.cell(centres[7, 11] + 0.04) == (7, 11)
    assert plane.cell(np.array([-9, 99])) == (0, 29)


def test_survey_knows_gaps_where_it_has_seen():
    plane = navigate.lay_plane(BOUNDS, 0.1)
    field = baked(wall_at(2.0), lambda p: 2.0 - p[..., 0])
    cells = navigate.survey(ROBOT, field, plane)
    x = plane.centres()[..., 0]
    seen = x < 2.0
    np.testing.assert_allclose(cells.gap[seen], 1.8 - x[seen], atol=1e-4)
    # A voxel or two behind the surface its distance counts, without a sign; then nothing is known.
    np.testing.assert_allclose(cells.gap[x > 2.35], np.inf)
    behind = (x > 2.0) & (x < 2.25)
    np.testing.assert_allclose(cells.gap[behind], x[behind] - 2.2, atol=1e-4)
    np.testing.assert_array_equal(cells.seen, x < 1.76)


def test_geodesic_equals_dijkstra():
    rng = np.random.default_rng(0)
    plane = navigate.Plane(np.array([0.1, 0.2]), 0.1, (9, 7))
    costs = rng.uniform(1, 5, plane.shape)
    goal = plane.centres()[6, 2]
    to_go, path_from = navigate.geodesic(costs, plane, goal)
    count = costs.size
    edges = np.zeros((count, count))
    for i, j in np.ndindex(*plane.shape):
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a, b = i + di, j + dj
            if 0 <= a < 9 and 0 <= b < 7:
                mean = (costs[i, j] + costs[a, b]) / 2
                length = 0.1 * math.hypot(di, dj) * mean
                edges[i * 7 + j, a * 7 + b] = edges[a * 7 + b, i * 7 + j] = length
    reference = dijkstra(csr_matrix(edges), indices=6 * 7 + 2).reshape(plane.shape)
    np.testing.assert_allclose(to_go, reference, atol=1e-9)
    path = path_from(plane.centres()[0, 6])
    np.testing.assert_allclose(path[0], plane.centres()[0, 6])
    np.testing.assert_allclose(path[-1], goal)
    assert np.abs(np.diff(path, axis=0)).max() < 0.1 + 1e-9


def test_the_way_goes_through_the_door_once_the_wall_is_seen_and_straight_before():
    plane = navigate.lay_plane(BOUNDS, 0.1)
    start, goal = np.array([0.55, 0.55]), np.array([3.45, 0.55])
    seen = baked(wall_with_door)
    _, path_from, _ = navigate.make_task(ROBOT, seen, plane, goal)
    path = path_from(start)
    crossing = path[np.argmin(np.abs(path[:, 0] - 2.0))]
    assert 2.0 + ROBOT.radius <= crossing[1] <= 2.8 - ROBOT.radius
    # A map that has seen nothing but the start.
    near = lambda p: 0.8 - np.hypot(p[..., 0] - 0.55, p[..., 1] - 0.55)  # noqa: E731
    blind = baked(lambda p: np.full(p.shape[:-1], 2.0), near)
    task, path_from, cells = navigate.make_task(ROBOT, blind, plane, goal)
    assert np.abs(path_from(start)[:, 1] - 0.55).max() < 0.11
    assert cells.seen.mean() < 0.1
    np.testing.assert_allclose(navigate.head(task, path_from, start).heading, [1, 0], atol=0.02)
    # What is barred is gone around though the map knows of nothing there.
    barred = np.zeros(plane.shape, bool)
    barred[19:21, :20] = True
    _, path_from, _ = navigate.make_task(ROBOT, blind, plane, goal, barred)
    assert path_from(start)[:, 1].max() > 1.9


def test_heading_looks_a_little_ahead_along_the_way():
    path = np.array([[0, 0], [0.5, 0], [1, 0], [1, 1.0], [1, 2]])
    np.testing.assert_allclose(navigate.heading_along(path, np.array([1.0, 0.1])), [0, 1])
    np.testing.assert_allclose(navigate.heading_along(path, np.array([0.1, 0.0])), [1, 0])
    np.testing.assert_allclose(navigate.heading_along(path, np.array([1.0, 2.0])), [0, 0])
