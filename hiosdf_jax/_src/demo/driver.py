"""Drives a robot to a goal on its map alone: MPPI down a geodesic, with a guard.

MPPI follows the cost to go of the geodesic. The guard accepts only controls after which the robot
can still stop clear of everything that the map takes as solid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax_mppi  # pyright: ignore[reportMissingImports]
import numpy as np

from hiosdf_jax._src.demo.geodesic import (
    Floor,
    PathFrom,
    Survey,
    cell_costs,
    cost_to_go,
    heading_along,
    survey,
)
from hiosdf_jax._src.demo.robot import Robot, braking, clearance, motion
from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.planning.adapters import mppi

_ROUNDING = 1e-5  # m, of a distance

# Costs per control step; jax-mppi's own cost of the noise is about 1 per step.
_PER_METER_TO_GO = 30.0
_PER_METER_NEAR = 100.0
_PER_METER_TOO_NEAR = 3000.0
_FACING_AWAY = 8.0


class Task(NamedTuple):
    """The input of a driver at one control step.

    Attributes:
        field: The map.
        to_go: Cost to go at the centers of the floor's cells, m, (X, Y).
        corner: Center of cell (0, 0), (2,) m.
        spacing: Edge of a cell, () m.
        heading: Direction of travel, (2,) unit vector.
    """

    field: Any
    to_go: jax.Array
    corner: jax.Array
    spacing: jax.Array
    heading: jax.Array


class Driver(NamedTuple):
    """One compiled control step, see `make_driver`.

    Attributes:
        step: (plan, state (5,), task) -> control (2,), new plan, and whether the guard refused
            MPPI's control and brakes instead.
        rollouts: (plan, state) -> (32, T + 1, 5), states of some of MPPI's rollouts.
        plan: The initial plan.
    """

    step: Callable[..., Any]
    rollouts: Callable[..., jax.Array]
    plan: jax_mppi.MPPIState


def make_driver(
    robot: Robot, unknown: Unknown, key: jax.Array, samples: int = 256, horizon: int = 15
) -> Driver:
    """Compiles one control step of MPPI and the guard.

    Args:
        robot: The robot.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        key: Source of MPPI's randomness.
        samples: Rollouts per step.
        horizon: Control steps per rollout.

    Returns:
        The step and the initial plan.
    """
    most = jnp.array([robot.max_acceleration, robot.max_turn_acceleration])
    settings, plan = jax_mppi.create(
        nx=5,
        nu=2,
        noise_sigma=jnp.diag((0.6 * most) ** 2),
        num_samples=samples,
        horizon=horizon,
        lambda_=5.0,
        u_min=-most,
        u_max=most,
        sample_null_action=True,
        key=key,
    )

    def next_state(state: jax.Array, control: jax.Array) -> jax.Array:
        return motion(robot, state, control)[-1]

    def cost(task: Task, state: jax.Array, control: jax.Array) -> jax.Array:
        gap = clearance(robot, task.field, state, unknown)
        heading = jnp.stack([jnp.cos(state[2]), jnp.sin(state[2])])
        return (
            _PER_METER_TO_GO * _interpolate(task, state[:2])
            + _PER_METER_NEAR * jax.nn.relu(robot.comfort - gap)
            + _PER_METER_TOO_NEAR * jax.nn.relu(robot.margin - gap)
            + _FACING_AWAY * (1 - jnp.dot(heading, task.heading))
        )

    def last_cost(task: Task, state: jax.Array, control: jax.Array) -> jax.Array:
        # A robot that still moves at the end must be able to stop.
        return 5 * cost(task, next_state(state, braking(robot, state)), control)

    mppi_step = mppi.controller(settings, next_state, cost, last_cost)
    stopping = math.ceil(robot.max_speed / (robot.max_acceleration * robot.step)) + 1

    @jax.jit
    def step(plan: Any, state: jax.Array, task: Task) -> tuple[jax.Array, Any, jax.Array]:
        control, plan = mppi_step(plan, state, task)
        first = motion(robot, state, control)

        def brake(state: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            states = motion(robot, state, braking(robot, state))
            return states[-1], states

        _, later = jax.lax.scan(brake, first[-1], length=stopping)
        ahead = jnp.concatenate([first, later.reshape(-1, 5)])
        gap = jnp.min(clearance(robot, task.field, ahead, unknown))
        # Where a new map puts the robot too near already, it may move if that brings it no nearer.
        now = clearance(robot, task.field, state, unknown)
        refused = gap < jnp.minimum(robot.margin, now - _ROUNDING)
        return jnp.where(refused, braking(robot, state), control), plan, refused

    @jax.jit
    def rollouts(plan: Any, state: jax.Array) -> jax.Array:
        return jax_mppi.get_rollouts(settings, plan, state, next_state, num_rollouts=32)

    return Driver(step, rollouts, plan)


def make_task(
    robot: Robot,
    field: AnyField,
    floor: Floor,
    goal: np.ndarray,
    barred: np.ndarray | None = None,
) -> tuple[Task, PathFrom, Survey]:
    """Plans the geodesic over a new map.

    Args:
        robot: The robot.
        field: The map.
        floor: The cells of the geodesic.
        goal: (2,) m.
        barred: See `cell_costs`.

    Returns:
        The task, with no heading yet; the path from any point; what the map knows of the cells.
    """
    cells = survey(robot, field, floor)
    to_go, path_from = cost_to_go(cell_costs(robot, cells, barred), floor, goal)
    task = Task(
        field=field,
        to_go=jnp.asarray(to_go, jnp.float32),
        corner=jnp.asarray(floor.corner, jnp.float32),
        spacing=jnp.float32(floor.spacing),
        heading=jnp.zeros(2),
    )
    return task, path_from, cells


def head(task: Task, path_from: PathFrom, xy: np.ndarray) -> Task:
    """Points a task's heading along the path from a point.

    Args:
        task: The task.
        path_from: The paths, from `make_task`.
        xy: (2,) m.

    Returns:
        The task with its heading.
    """
    return task._replace(heading=jnp.asarray(heading_along(path_from(xy), xy), jnp.float32))


def _interpolate(task: Task, xy: jax.Array) -> jax.Array:
    """Cost to go at a point, bilinearly, (2,) -> ()."""
    place = (xy - task.corner) / task.spacing
    return jax.scipy.ndimage.map_coordinates(task.to_go, [*place], order=1, mode="nearest")
