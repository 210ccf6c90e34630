"""A robot that finds its way through the apartment to a room that it has not seen.

All that it knows is its own map. At every control step it may sense with a noisy depth camera and
update the map, and drives by MPPI, taking unseen space for solid.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.demo import navigate
from hiosdf_jax._src.demo.apartment import BOUNDS_WORLD, load_model
from hiosdf_jax._src.demo.camera import DepthCamera
from hiosdf_jax._src.demo.primitives import signed_distance
from hiosdf_jax._src.field.points import Unknown
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.state import Field

# A body of 0.4 m across, from 0.15 m above the floor to 1.25 m.
ROBOT = navigate.Robot(heights=(0.35, 0.49, 0.63, 0.77, 0.91, 1.05))
REACHED = 0.25  # m from the goal

_ROOMS = {  # inner faces, ((x0, y0), (x1, y1)) m
    "living room": ((0.0, 0.0), (5.6, 4.4)),
    "kitchen": ((5.7, 0.0), (10.0, 4.4)),
    "hall": ((7.5, 4.5), (10.0, 8.0)),
    "bedroom": ((3.3, 4.5), (7.4, 8.0)),
    "study": ((0.0, 4.5), (3.2, 8.0)),
}
_ROOM_TO_PASS = 0.1  # m of clearance on a way that there must be
_ROOM_TO_START = 0.15  # m more around a robot that is put down, and around its goal

# The camera looks out of the body's front, upright (portrait), over the floor just ahead; when the
# robot looks around it nods, since what is overhead nearby is not seen from there otherwise.
_CAMERA_AHEAD, _CAMERA_HEIGHT = 0.2, 1.1
_PITCH_DRIVING, _PITCHES_LOOKING = np.radians(25), np.radians([25, -15])  # downwards
_WIDTH, _HEIGHT, _MAX_RANGE = 108, 144, 5.0
_MAP_TOP = 2.0  # m; nothing higher matters to the robot
_CELL = 0.1  # m, of the geodesic's plane

_SENSE_EVERY, _SENSE_EVERY_TURNING = 3, 2  # control steps
_TIME_LIMIT = 240.0  # s
_STUCK_AFTER, _STUCK_WITHIN = 5.0, 0.15  # s without leaving a circle of so many m
_BAR_AHEAD = 1.0  # m of the way that are barred when looking around did not help


class Problem(NamedTuple):
    """Where a robot starts and where it is to go.

    Attributes:
        start: (3,) x, y (m), yaw (rad).
        goal: (2,) x, y (m).
        rooms: Names of the rooms of both.
    """

    start: np.ndarray
    goal: np.ndarray
    rooms: tuple[str, str]


class Moment(NamedTuple):
    """What the robot knew and meant to do after an update of its map.

    Attributes:
        step: Control steps before it.
        cells: What the map said of the plane.
        path: The way that it meant to go, (P, 2) m.
        rollouts: Of MPPI, (K, T, 2) m.
        turning: Whether it turned on the spot to look around.
    """

    step: int
    cells: navigate.Survey
    path: np.ndarray
    rollouts: np.ndarray
    turning: bool


class Run(NamedTuple):
    """A robot's way to its goal.

    Attributes:
        problem: Start and goal.
        states: (N + 1, 5) at the control steps, see `navigate.Robot`.
        clearance: (N + 1,) m, what its map said then, unseen space taken for solid.
        exact_clearance: (N + 1,) m, the least of the true one over each step.
        moments: After each update of the map.
        plane: The cells of the moments.
        field: The map in the end.
        metrics: Scalars.
    """

    problem: Problem
    states: np.ndarray
    clearance: np.ndarray
    exact_clearance: np.ndarray
    moments: list[Moment]
    plane: navigate.Plane
    field: Field
    metrics: dict[str, Any]


def draw_problem(model: Any, seed: int) -> Problem:
    """Draws a start and a goal in another room, out of sight and with a way between them.

    Args:
        model: The apartment.
        seed: Of the draw.

    Returns:
        The problem.
    """
    from scipy.ndimage import distance_transform_edt, label

    rng = np.random.default_rng(seed)
    plane = navigate.lay_plane(BOUNDS_WORLD, _CELL)
    centres = plane.centres()
    gap = exact_clearance(model, centres.reshape(-1, 2), samples=len(ROBOT.heights))
    passable = gap.reshape(plane.shape) > _ROOM_TO_PASS
    regions: Any = label(passable)[0]  # pyright: ignore[reportIndexIssue]
    roomy = plane.spacing * np.asarray(distance_transform_edt(passable)) > _ROOM_TO_START
    names = list(_ROOMS)
    while True:
        first, second = rng.choice(len(names), 2, replace=False).tolist()
        start = _draw_cell(roomy, centres, _ROOMS[names[first]], rng)
        goal = _draw_cell(roomy, centres, _ROOMS[names[second]], rng)
        xy, goal_xy = centres[start], centres[goal]
        if regions[start] == regions[goal] and not _in_sight(model, xy, goal_xy):
            yaw = rng.uniform(-np.pi, np.pi)
            return Problem(np.array([*xy, yaw]), goal_xy, (names[first], names[second]))


def exact_clearance(model: Any, xy: np.ndarray, samples: int = 16) -> np.ndarray:
    """True distance between the robot's body and the apartment.

    Args:
        model: The apartment.
        xy: (N, 2) m, where the robot is.
        samples: Of the axis of the capsule that the spheres of the body span.

    Returns:
        (N,) m; negative in collision.
    """
    heights = np.linspace(ROBOT.heights[0], ROBOT.heights[-1], samples)
    points = np.concatenate(
        [np.repeat(xy, len(heights), axis=0), np.tile(heights, len(xy))[:, None]], axis=1
    )
    return signed_distance(model, points)[0].reshape(len(xy), -1).min(axis=1) - ROBOT.radius


def camera_pose(state: np.ndarray, pitch: float) -> np.ndarray:
    """Where the camera is when the robot is in a state.

    Args:
        state: (5,), or its first three: x, y (m), yaw (rad).
        pitch: How far it looks below the horizon, rad.

    Returns:
        (4, 4) T_world_sensor, optical frame (x right, y down, z forward).
    """
    x, y, yaw = np.asarray(state[:3], float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward = np.array([cos, sin, -np.tan(pitch)]) * np.cos(pitch)
    right = np.array([sin, -cos, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = x + _CAMERA_AHEAD * cos, y + _CAMERA_AHEAD * sin, _CAMERA_HEIGHT
    return pose


def map_config() -> Config:
    """The configuration of the robot's map: smaller than `Config.light`."""
    low, (x, y, _) = BOUNDS_WORLD
    return Config.light(
        (low, (x, y, _MAP_TOP)),
        max_range=_MAX_RANGE,
        max_points=_WIDTH * _HEIGHT,
        near_samples=3000,
        far_samples=6000,
        local_points=50,
        hidden_width=64,
        hidden_layers=1,
        distance_horizon=1.5,
        frontier_horizon=0.6,
    )


def explore(seed: int, unknown: Unknown = "obstacle") -> Run:
    """Lets a robot find its way.

    Args:
        seed: Of start, goal, the camera's noise, the map's and MPPI's randomness.
        unknown: Policy for unseen space, see `hiosdf_jax.sdf`.

    Returns:
        The run; `metrics["reached"]` and `metrics["collided"]` say how it ended.
    """
    begin = time.perf_counter()
    model = load_model()
    problem = draw_problem(model, seed)
    camera = DepthCamera(model, _WIDTH, _HEIGHT, _MAX_RANGE, noise=True)
    key, plan_key = jax.random.split(jax.random.key(seed))
    driver = navigate.make_driver(ROBOT, unknown, plan_key)
    plane = navigate.lay_plane(BOUNDS_WORLD, _CELL)
    map_state = _put_down(pipeline.init(map_config(), key), problem.start)

    state, plan = jnp.array([*problem.start, 0.0, 0.0], jnp.float32), driver.plan
    watch = _Watch(problem.start[:2])
    barred = np.zeros(plane.shape, bool)
    states, passed, clearances, moments = [np.asarray(state)], [], [], []
    update_seconds, step_seconds, refusals = [], [], 0
    task = path_from = field = None
    reached, steps = False, int(_TIME_LIMIT / ROBOT.step)
    for k in range(steps):
        xy = np.asarray(state[:2], float)
        if k % (_SENSE_EVERY_TURNING if watch.turning else _SENSE_EVERY) == 0:
            start = time.perf_counter()
            pitch = _PITCHES_LOOKING[len(moments) % 2] if watch.turning else _PITCH_DRIVING
            pose = camera_pose(np.asarray(state), float(pitch))
            map_state = pipeline.update(map_state, camera.cloud(pose, (seed, k)), pose)
            field = pipeline.snapshot(map_state, k * ROBOT.step)
            task, path_from, cells = navigate.make_task(ROBOT, field, plane, problem.goal, barred)
            update_seconds.append(time.perf_counter() - start)
            rollouts = np.asarray(driver.rollouts(plan, state))[..., :2]
            moments.append(Moment(k, cells, path_from(xy), rollouts, watch.turning))
        assert task is not None and path_from is not None and field is not None
        clearances.append(float(_clearance(ROBOT, field, state, unknown)))

        start = time.perf_counter()
        if watch.turning:
            control = _turn_on_the_spot(np.asarray(state))
        else:
            task = navigate.head(task, path_from, xy)
            control, plan, refused = driver.step(plan, state, task)
            refusals += int(refused)
        moved = np.asarray(navigate.motion(ROBOT, state, control))
        step_seconds.append(time.perf_counter() - start)
        state = jnp.asarray(moved[-1])
        states.append(moved[-1])
        passed.append(moved[:, :2])
        reached = bool(np.linalg.norm(moved[-1, :2] - problem.goal) < REACHED)
        if reached:
            break
        if watch.looked_in_vain(moved[-1]):
            barred |= _bar(plane, path_from(moved[-1, :2]), moments[-1].cells)

    assert field is not None
    clearances.append(float(_clearance(ROBOT, field, state, unknown)))
    path = np.concatenate([problem.start[None, :2], *passed])
    exact = exact_clearance(model, path)
    exact = np.concatenate([exact[:1], exact[1:].reshape(len(passed), -1).min(axis=1)])
    first_drive = next((moment for moment in moments if not moment.turning), moments[-1])
    metrics = {
        "seed": seed,
        "unknown": unknown,
        "from": problem.rooms[0],
        "to": problem.rooms[1],
        "start": problem.start.tolist(),
        "goal": problem.goal.tolist(),
        "goal_seen_from_start": bool(first_drive.cells.seen[plane.cell(problem.goal)]),
        "reached": reached,
        "collided": bool(exact.min() < 0),
        "least_clearance_m": float(exact.min()),
        "robot_s": len(passed) * ROBOT.step,
        "path_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        "updates": len(update_seconds),
        "looks_around": len(watch.places),
        "cells_barred": int(barred.sum()),
        "steps_refused": refusals,
        "sense_and_update_median_ms": 1000 * float(np.median(update_seconds)),
        "step_median_ms": 1000 * float(np.median(step_seconds)),
        "wall_s": time.perf_counter() - begin,
        "device": jax.devices()[0].device_kind,
    }
    return Run(
        problem, np.array(states), np.array(clearances), exact, moments, plane, field, metrics
    )


class _Watch:
    """Decides when to look around: at the start, and after a while without getting anywhere."""

    def __init__(self, xy: np.ndarray) -> None:
        self.turning, self.places = True, [xy]
        self._turned = 0.0  # rad
        self._anchor, self._seconds = xy, 0.0  # it has been near there for so long

    def looked_in_vain(self, state: np.ndarray) -> bool:
        """Takes note of a control step; whether it is stuck where it has looked around before."""
        xy = state[:2]
        if self.turning:
            self._turned += abs(float(state[4])) * ROBOT.step
            self.turning = self._turned < 2 * np.pi
            self._anchor, self._seconds = xy, 0.0
            return False
        self._seconds += ROBOT.step
        if np.linalg.norm(xy - self._anchor) > _STUCK_WITHIN:
            self._anchor, self._seconds = xy, 0.0
        if self._seconds < _STUCK_AFTER:
            return False
        again = any(np.linalg.norm(place - xy) < 2 * _STUCK_WITHIN for place in self.places)
        self.turning, self._turned = True, 0.0
        self.places.append(xy)
        return again


def _put_down(state: Any, start: np.ndarray) -> Any:
    """Tells the map that the robot was put down in a clear place.

    A camera cannot look beneath itself, and space that nobody has seen is solid: without this the
    robot would take itself for walled in. The floor around it is seen from above.
    """
    radius, height = 0.45, 4.5
    spots = np.linspace(-radius, radius, 31)
    x, y = (axis.ravel() for axis in np.meshgrid(spots, spots))
    disc = np.hypot(x, y) <= radius
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # looks down
    pose[:3, 3] = *start[:2], height
    cloud = np.column_stack([x[disc], y[disc], np.full(disc.sum(), height)])
    return pipeline.update(state, cloud.astype(np.float32), pose)


def _draw_cell(
    roomy: np.ndarray, centres: np.ndarray, room: Any, rng: np.random.Generator
) -> tuple[int, int]:
    inside = ((centres >= room[0]) & (centres <= room[1])).all(axis=-1)
    cells = np.argwhere(roomy & inside)
    i, j = cells[rng.integers(len(cells))].tolist()
    return i, j


def _in_sight(model: Any, start: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the straight line between two places, at the camera's height, is free."""
    along = np.linspace(0, 1, 200)[:, None]
    points = np.column_stack([start + along * (goal - start), np.full(200, _CAMERA_HEIGHT)])
    return bool((signed_distance(model, points)[0] > 0).all())


def _turn_on_the_spot(state: np.ndarray) -> jax.Array:
    turn = (ROBOT.max_turn_rate - state[4]) / ROBOT.step
    return jnp.asarray([-state[3] / ROBOT.step, turn])


def _bar(plane: navigate.Plane, path: np.ndarray, cells: navigate.Survey) -> np.ndarray:
    """The next cells of a way that the robot may not enter, (X, Y) bool."""
    barred = np.zeros(plane.shape, bool)
    near = np.linalg.norm(path - path[0], axis=1) < _BAR_AHEAD
    for xy in path[near]:
        i, j = plane.cell(xy)
        if not cells.seen[i, j]:
            barred[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = True
    return barred


_clearance = jax.jit(navigate.clearance, static_argnums=(0, 3))
