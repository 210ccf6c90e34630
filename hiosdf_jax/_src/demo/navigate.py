"""A round robot that drives to a goal on nothing but its map: MPPI down a geodesic, with a guard.

Three layers. A geodesic over the plane takes unseen space for free, since what leads into it may
lead to the goal. MPPI drives down it with the map's policy for unseen space. A guard lets through
only controls after which the robot can still stop clear of all that the policy takes for solid.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax_mppi  # pyright: ignore[reportMissingImports]
import numpy as np

from hiosdf_jax._src.field.points import AnyField, Unknown, query, sdf
from hiosdf_jax._src.numerics.gradient import least
from hiosdf_jax._src.planning.adapters import mppi

PathFrom = Callable[[np.ndarray], np.ndarray]

_SUBSTEPS = 4  # of a control step, in motion and in the guard's look ahead

_ROUNDING = 1e-5  # m, of a distance

# Costs a control step; jax-mppi's own cost of the noise is about one a step.
_PER_METRE_TO_GO = 30.0
_PER_METRE_NEAR = 100.0
_PER_METRE_TOO_NEAR = 3000.0
_FACING_AWAY = 8.0

# Costs of a cell of the plane, relative to one that is seen and free.
_UNSEEN = 1.5
_NEAR = 3.0
_BLOCKED = 100.0
_REACH_INTO_UNSEEN = 0.3  # m beyond what was seen in which surfaces still count


@dataclasses.dataclass(frozen=True)
class Robot:
    """A vertical capsule on a differential drive; the state is (x, y, yaw, speed, turn rate).

    Attributes:
        heights: Of the spheres that make the body, m above the world's origin.
        radius: Of these spheres, m.
        max_speed: Forwards, m/s; it does not drive backwards, where it does not look.
        max_turn_rate: rad/s.
        max_acceleration: m/s^2, speeding up and braking.
        max_turn_acceleration: rad/s^2.
        margin: Clearance that the guard insists on, m.
        comfort: Clearance below which driving costs more, m.
        step: Length of a control step, s.
    """

    heights: tuple[float, ...]
    radius: float = 0.2
    max_speed: float = 0.6
    max_turn_rate: float = 1.5
    max_acceleration: float = 1.0
    max_turn_acceleration: float = 4.0
    margin: float = 0.04
    comfort: float = 0.15
    step: float = 0.2


class Task(NamedTuple):
    """What the driver is given at every step.

    Attributes:
        field: The map.
        to_go: Cost to go at the centres of the plane's cells, m, (X, Y).
        corner: Centre of cell (0, 0), (2,) m.
        spacing: Of the cells, () m.
        heading: Direction in which to go, (2,) unit vector.
    """

    field: Any
    to_go: jax.Array
    corner: jax.Array
    spacing: jax.Array
    heading: jax.Array


class Plane(NamedTuple):
    """The level cells that the geodesic runs over.

    Attributes:
        corner: Centre of cell (0, 0), (2,) m.
        spacing: m.
        shape: Cells along x and y.
    """

    corner: np.ndarray
    spacing: float
    shape: tuple[int, int]

    def cell(self, xy: np.ndarray) -> tuple[int, int]:
        """The cell that contains a point, or the nearest to it."""
        index = np.rint((np.asarray(xy, float) - self.corner) / self.spacing).astype(int)
        i, j = np.clip(index, 0, np.array(self.shape) - 1).tolist()
        return i, j

    def centres(self) -> np.ndarray:
        """(X, Y, 2) m."""
        return self.corner + self.spacing * np.indices(self.shape).transpose(1, 2, 0)


class Survey(NamedTuple):
    """What the map says of the plane's cells.

    Attributes:
        gap: Clearance to surfaces that were seen, over the body's height, m, (X, Y); inf where
            there is none near what was seen.
        seen: Whether the body would be in space that was seen, (X, Y) bool.
    """

    gap: np.ndarray
    seen: np.ndarray


class Driver(NamedTuple):
    """One compiled control step, see `make_driver`.

    Attributes:
        step: (plan, state (5,), task) -> control (2,), plan, whether the guard refused MPPI's
            control and brakes instead.
        rollouts: (plan, state) -> (32, T + 1, 5), states of some that MPPI tries.
        plan: The first plan.
    """

    step: Callable[..., Any]
    rollouts: Callable[..., jax.Array]
    plan: jax_mppi.MPPIState


def lay_plane(bounds: Any, spacing: float) -> Plane:
    """Covers the x and y of a box with cells.

    Args:
        bounds: ((x0, y0, z0), (x1, y1, z1)) m.
        spacing: Of the cells, m.

    Returns:
        The plane.
    """
    low, high = np.asarray(bounds, float)[:, :2]
    x, y = np.ceil((high - low) / spacing - 1e-6).astype(int).tolist()
    return Plane(low + spacing / 2, spacing, (x, y))


@partial(jax.jit, static_argnums=0)
def motion(robot: Robot, state: jax.Array, control: jax.Array) -> jax.Array:
    """The states that a robot passes through in one control step.

    Args:
        robot: The robot.
        state: (5,) x, y (m), yaw (rad), speed (m/s), turn rate (rad/s).
        control: (2,) acceleration (m/s^2), turn acceleration (rad/s^2); limited to what it can do.

    Returns:
        (4, 5), at even times; the last is the state after the step.
    """
    limit = jnp.array([robot.max_acceleration, robot.max_turn_acceleration])
    acceleration, turn_acceleration = jnp.clip(control, -limit, limit)
    x, y, yaw, speed, rate = state
    states = []
    dt = robot.step / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        speed = jnp.clip(speed + dt * acceleration, 0, robot.max_speed)
        rate = jnp.clip(rate + dt * turn_acceleration, -robot.max_turn_rate, robot.max_turn_rate)
        yaw = yaw + dt * rate
        x, y = x + dt * speed * jnp.cos(yaw), y + dt * speed * jnp.sin(yaw)
        states.append(jnp.stack([x, y, yaw, speed, rate]))
    return jnp.stack(states)


def braking(robot: Robot, state: jax.Array) -> jax.Array:
    """The control that comes nearest to a stop within one step.

    Args:
        robot: The robot.
        state: (5,).

    Returns:
        (2,) acceleration, turn acceleration.
    """
    limit = jnp.array([robot.max_acceleration, robot.max_turn_acceleration])
    return jnp.clip(-state[3:] / robot.step, -limit, limit)


def clearance(robot: Robot, field: AnyField, states: jax.Array, unknown: Unknown) -> jax.Array:
    """Distance between a robot's body and what the map takes for solid.

    Args:
        robot: The robot.
        field: The map.
        states: (..., 5), or their first two.
        unknown: Policy for unseen space, see `hiosdf_jax.sdf`.

    Returns:
        (...) m.
    """
    return least(sdf(field, body(robot, states), unknown)) - robot.radius


def body(robot: Robot, states: Any) -> jax.Array:
    """Centres of the spheres of a robot's body.

    Args:
        robot: The robot.
        states: (..., 5), or their first two.

    Returns:
        (..., S, 3) m, world.
    """
    states = jnp.asarray(states)
    heights = jnp.asarray(robot.heights, jnp.float32)
    xy = jnp.broadcast_to(states[..., None, :2], (*states.shape[:-1], len(heights), 2))
    z = jnp.broadcast_to(heights, xy.shape[:-1])
    return jnp.concatenate([xy, z[..., None]], axis=-1)


def make_driver(
    robot: Robot, unknown: Unknown, key: jax.Array, samples: int = 256, horizon: int = 15
) -> Driver:
    """Compiles one control step: MPPI, then the guard.

    Args:
        robot: The robot.
        unknown: Policy for unseen space, of both.
        key: Source of MPPI's randomness.
        samples: Rollouts a step.
        horizon: Control steps of a rollout.

    Returns:
        The step, and the first plan.
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
            _PER_METRE_TO_GO * _interpolate(task, state[:2])
            + _PER_METRE_NEAR * jax.nn.relu(robot.comfort - gap)
            + _PER_METRE_TOO_NEAR * jax.nn.relu(robot.margin - gap)
            + _FACING_AWAY * (1 - jnp.dot(heading, task.heading))
        )

    def last_cost(task: Task, state: jax.Array, control: jax.Array) -> jax.Array:
        # Whoever still moves at the end must be able to stop.
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
        # Whoever is too near already, by what a new map says, may go where it is no worse.
        now = clearance(robot, task.field, state, unknown)
        refused = gap < jnp.minimum(robot.margin, now - _ROUNDING)
        return jnp.where(refused, braking(robot, state), control), plan, refused

    @jax.jit
    def rollouts(plan: Any, state: jax.Array) -> jax.Array:
        return jax_mppi.get_rollouts(settings, plan, state, next_state, num_rollouts=32)

    return Driver(step, rollouts, plan)


def survey(robot: Robot, field: AnyField, plane: Plane) -> Survey:
    """Asks the map what a robot would meet in each cell of the plane.

    Args:
        robot: The robot.
        field: The map.
        plane: The cells.

    Returns:
        What is known of each cell.
    """
    points = body(robot, plane.centres().astype(np.float32))
    distance, frontier = (np.asarray(a) for a in _distance_and_frontier(field, points))
    # Behind what was seen, the sign is a guess, but not that there is a surface.
    unsigned = np.where(frontier > 0, distance, np.abs(distance))
    known = frontier > -_REACH_INTO_UNSEEN
    return Survey(
        gap=np.where(known, unsigned, np.inf).min(axis=-1) - robot.radius,
        seen=(frontier > robot.radius + robot.margin).all(axis=-1),
    )


def cell_costs(robot: Robot, cells: Survey, barred: np.ndarray | None = None) -> np.ndarray:
    """What it costs to cross each cell of the plane, relative to a free one.

    Cells where the body would touch a surface that was seen cost so much that the geodesic goes
    around them; cells that were not seen at all heights of the body cost little more than free.

    Args:
        robot: The robot.
        cells: What is known of them.
        barred: (X, Y) bool, cells to go around whatever the map says.

    Returns:
        (X, Y) float64.
    """
    costs = np.where(cells.seen, 1.0, _UNSEEN)
    costs += _NEAR * np.clip(1 - cells.gap / robot.comfort, 0, 1)
    blocked = cells.gap < robot.margin
    if barred is not None:
        blocked |= barred
    return np.where(blocked, _BLOCKED, costs)


def geodesic(costs: np.ndarray, plane: Plane, goal: np.ndarray) -> tuple[np.ndarray, PathFrom]:
    """Cost of the cheapest way from each cell to a goal.

    Args:
        costs: (X, Y), of crossing a cell.
        plane: The cells.
        goal: (2,) m.

    Returns:
        to_go: (X, Y) m of free cells.
        path_from: (2,) m -> (P, 2) m, the way from there to the goal.
    """
    from skimage.graph import MCP_Geometric

    search = MCP_Geometric(costs * plane.spacing)
    to_go, _ = search.find_costs([plane.cell(goal)])

    def path_from(xy: np.ndarray) -> np.ndarray:
        cells = np.array(search.traceback(plane.cell(xy)))[::-1]
        return plane.corner + plane.spacing * cells

    return to_go, path_from


def make_task(
    robot: Robot,
    field: AnyField,
    plane: Plane,
    goal: np.ndarray,
    barred: np.ndarray | None = None,
) -> tuple[Task, PathFrom, Survey]:
    """Plans the ways over a new map.

    Args:
        robot: The robot.
        field: The map.
        plane: The cells of the geodesic.
        goal: (2,) m.
        barred: See `cell_costs`.

    Returns:
        The task, with no heading yet; the way from any place; what is known of the cells.
    """
    cells = survey(robot, field, plane)
    to_go, path_from = geodesic(cell_costs(robot, cells, barred), plane, goal)
    task = Task(
        field=field,
        to_go=jnp.asarray(to_go, jnp.float32),
        corner=jnp.asarray(plane.corner, jnp.float32),
        spacing=jnp.float32(plane.spacing),
        heading=jnp.zeros(2),
    )
    return task, path_from, cells


def head(task: Task, path_from: PathFrom, xy: np.ndarray) -> Task:
    """Turns a task's heading to where the way leads from a place.

    Args:
        task: The task.
        path_from: The ways, from `make_task`.
        xy: (2,) m.

    Returns:
        The task with its heading.
    """
    return task._replace(heading=jnp.asarray(heading_along(path_from(xy), xy), jnp.float32))


def heading_along(path: np.ndarray, xy: np.ndarray, ahead: float = 0.6) -> np.ndarray:
    """Direction from a place to the point of a path that lies a little ahead.

    Args:
        path: (P, 2) m.
        xy: (2,) m.
        ahead: How far the point is from the place, m.

    Returns:
        (2,) unit vector, or zero at the path's end.
    """
    offsets = path - xy
    lengths = np.linalg.norm(offsets, axis=1)
    start = int(np.argmin(lengths))
    beyond = np.nonzero(lengths[start:] >= ahead)[0]
    target = start + int(beyond[0]) if len(beyond) else len(path) - 1
    return offsets[target] / max(lengths[target], 1e-6)


def _interpolate(task: Task, xy: jax.Array) -> jax.Array:
    """Cost to go at a point, bilinearly, (2,) -> ()."""
    place = (xy - task.corner) / task.spacing
    return jax.scipy.ndimage.map_coordinates(task.to_go, [*place], order=1, mode="nearest")


@jax.jit
def _distance_and_frontier(field: AnyField, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    answer = query(field, points)
    return answer.sdf, answer.frontier
