"""The driver: its guard, and its paths around what the map knows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import baked

from hiosdf_jax._src.demo.geodesic import lay_floor
from hiosdf_jax._src.demo.robot import Robot, motion

pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from hiosdf_jax._src.demo.driver import Task, head, make_driver, make_task

ROBOT = Robot(heights=(0.3, 0.5))
BOUNDS = ((0.0, 0.0, 0.0), (4.0, 3.0, 1.0))


def field_of(sdf, frontier=None):
    """A map of functions of points (..., 3) over BOUNDS."""
    return baked(sdf, *BOUNDS, 0.1, frontier)


def wall_with_door(points):
    """A wall 0.2 m thick at x = 2 with a door over y in (2.0, 2.8)."""
    x, y = points[..., 0] - 2.0, points[..., 1]

    def post(center, half):
        dx, dy = np.abs(x) - 0.1, np.abs(y - center) - half
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
        return outside + np.minimum(np.maximum(dx, dy), 0)

    return np.minimum(post(0.5, 1.5), post(3.8, 1.0))


@functools.cache
def driver_with(unknown):
    return make_driver(ROBOT, unknown, jax.random.key(0), samples=64, horizon=8)


def drive_at(field, unknown, steps=40, reward=1.0):
    """Drives along x for a reward; returns the states and whether the guard refused each step."""
    driver = driver_with(unknown)
    floor = lay_floor(BOUNDS, 0.1)
    task = Task(
        field=field,
        to_go=jnp.asarray(reward * (4 - floor.centers()[..., 0]), jnp.float32),
        corner=jnp.asarray(floor.corner, jnp.float32),
        spacing=jnp.float32(floor.spacing),
        heading=jnp.array([1.0, 0.0]),
    )
    plan, state = driver.plan, jnp.array([0.5, 1.5, 0.0, 0.0, 0.0])
    states, refusals = [], []
    for _ in range(steps):
        control, plan, refused = driver.step(plan, state, task)
        states.append(np.asarray(motion(ROBOT, state, control)))
        state = jnp.asarray(states[-1][-1])
        refusals.append(bool(refused))
    return np.concatenate(states), refusals


def test_the_guard_stops_a_robot_that_drives_at_a_wall():
    # The reward dwarfs all costs of collision: only the guard can stop it.
    states, refusals = drive_at(field_of(lambda p: 2.5 - p[..., 0]), "network", reward=1e4)
    assert any(refusals)
    furthest = states[:, 0].max() + ROBOT.radius
    assert 2.2 < furthest <= 2.5 - ROBOT.margin + 1e-4


@pytest.mark.parametrize(("unknown", "enters"), [("obstacle", False), ("network", True)])
def test_unseen_space_is_entered_under_one_policy_only(unknown, enters):
    open_space = field_of(lambda p: np.full(p.shape[:-1], 2.0), lambda p: 2.0 - p[..., 0])
    states, _ = drive_at(open_space, unknown, reward=1e4 if not enters else 1.0)
    furthest = states[:, 0].max() + ROBOT.radius
    assert (furthest > 2.5) if enters else (1.7 < furthest <= 2.0 - ROBOT.margin + 1e-4)


def test_the_guard_lets_a_robot_leave_a_place_that_is_too_near():
    # The map puts a wall behind the robot, inside its margin.
    states, _ = drive_at(field_of(lambda p: p[..., 0] - 0.28), "network")
    assert states[-1, 0] > 1.5


def test_the_path_is_straight_until_the_wall_is_seen_and_then_uses_the_door():
    floor = lay_floor(BOUNDS, 0.1)
    start, goal = np.array([0.55, 0.55]), np.array([3.45, 0.55])
    _, path_from, _ = make_task(ROBOT, field_of(wall_with_door), floor, goal)
    path = path_from(start)
    crossing = path[np.argmin(np.abs(path[:, 0] - 2.0))]
    assert 2.0 + ROBOT.radius <= crossing[1] <= 2.8 - ROBOT.radius

    def near_start(points):
        return 0.8 - np.hypot(points[..., 0] - 0.55, points[..., 1] - 0.55)

    blind = field_of(lambda p: np.full(p.shape[:-1], 2.0), near_start)
    task, path_from, cells = make_task(ROBOT, blind, floor, goal)
    assert np.abs(path_from(start)[:, 1] - 0.55).max() < 0.11
    assert cells.seen.mean() < 0.1
    np.testing.assert_allclose(head(task, path_from, start).heading, [1, 0], atol=0.02)
    # The path avoids barred cells although the map knows nothing of them.
    barred = np.zeros(floor.shape, bool)
    barred[19:21, :20] = True
    _, path_from, _ = make_task(ROBOT, blind, floor, goal, barred)
    assert path_from(start)[:, 1].max() > 1.9
