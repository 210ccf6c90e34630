"""A robot that finds its way through the apartment to a room that it has not seen.

It knows only its own map. It takes images with a noisy depth camera, updates the map, and drives by
MPPI. Space that it has not seen is solid.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.demo.apartment import BOUNDS_WORLD, load_model
from hiosdf_jax._src.demo.driver import head, make_driver, make_task
from hiosdf_jax._src.demo.geodesic import Floor, Survey, lay_floor
from hiosdf_jax._src.demo.problem import Problem, draw_problem, exact_clearance
from hiosdf_jax._src.demo.robot import Robot, clearance, motion
from hiosdf_jax._src.demo.sensing import (
    CAMERA_HEIGHT,
    camera_pose,
    map_config,
    robot_camera,
    scan_from_above,
)
from hiosdf_jax._src.mapping import lifecycle, pipeline
from hiosdf_jax._src.state.pytrees import Field

# A body 0.4 m wide, from 0.15 m to 1.25 m above the floor.
ROBOT = Robot(heights=(0.35, 0.49, 0.63, 0.77, 0.91, 1.05))
_UNKNOWN = "obstacle"  # unseen space is solid
_REACHED = 0.25  # m from the goal
_CELL = 0.1  # m, of the geodesic's floor

# When the robot looks around, the camera nods: otherwise it never sees what is overhead nearby.
_PITCH_DRIVING, _PITCHES_LOOKING = np.radians(25), np.radians([25, -15])  # downward
_SENSE_EVERY, _SENSE_EVERY_TURNING = 3, 2  # control steps
_TIME_LIMIT = 240.0  # s
_STUCK_AFTER, _STUCK_WITHIN = 5.0, 0.15  # s, m: stuck if it stays within this radius for this long
_BAR_AHEAD = 1.0  # m of the path that is barred when looking around did not help


class Decision(NamedTuple):
    """What the robot knew and planned after an update of its map.

    Attributes:
        step: Number of control steps before it.
        cells: What the map knew of the floor.
        path: The planned path, (P, 2) m.
        rollouts: Positions in MPPI's rollouts, (K, T, 2) m.
        turning: Whether the robot turned on the spot to look around.
    """

    step: int
    cells: Survey
    path: np.ndarray
    rollouts: np.ndarray
    turning: bool


class Run(NamedTuple):
    """A robot's exploration from start to end.

    Attributes:
        problem: Start and goal.
        states: (N + 1, 5) at the control steps, see `Robot`.
        clearance: (N + 1,) m, in the map of that time, unseen space as the policy takes it.
        exact_clearance: (N + 1,) m, the least exact clearance over each step.
        decisions: One per update of the map.
        floor: The cells of the decisions.
        field: The final map.
        metrics: Scalars.
    """

    problem: Problem
    states: np.ndarray
    clearance: np.ndarray
    exact_clearance: np.ndarray
    decisions: list[Decision]
    floor: Floor
    field: Field
    metrics: dict[str, Any]


def explore(seed: int) -> Run:
    """Lets a robot find its way to a goal in another room.

    Args:
        seed: Seed of start and goal, and of the randomness of camera, map and MPPI.

    Returns:
        The run. `metrics["reached"]` and `metrics["collided"]` give the outcome.
    """
    begin = time.perf_counter()
    model = load_model()
    floor = lay_floor(BOUNDS_WORLD, _CELL)
    problem = draw_problem(model, ROBOT, floor, CAMERA_HEIGHT, seed)
    camera = robot_camera(model)
    key, plan_key = jax.random.split(jax.random.key(seed))
    driver = make_driver(ROBOT, _UNKNOWN, plan_key)
    map_state = scan_from_above(lifecycle.init(map_config(), key), problem.start[:2])

    state, plan = jnp.array([*problem.start, 0.0, 0.0], jnp.float32), driver.plan
    watch = _Watch(problem.start[:2])
    barred = np.zeros(floor.shape, bool)
    states, passed, clearances, decisions = [np.asarray(state)], [], [], []
    update_seconds, step_seconds, refusals = [], [], 0
    task = path_from = field = None
    reached, steps = False, int(_TIME_LIMIT / ROBOT.step)
    for k in range(steps):
        xy = np.asarray(state[:2], float)
        if k % (_SENSE_EVERY_TURNING if watch.turning else _SENSE_EVERY) == 0:
            start = time.perf_counter()
            pitch = _PITCHES_LOOKING[len(decisions) % 2] if watch.turning else _PITCH_DRIVING
            pose = camera_pose(np.asarray(state), float(pitch))
            map_state = pipeline.update(map_state, camera.cloud(pose, (seed, k)), pose)
            field = lifecycle.snapshot(map_state, k * ROBOT.step)
            task, path_from, cells = make_task(ROBOT, field, floor, problem.goal, barred)
            update_seconds.append(time.perf_counter() - start)
            rollouts = np.asarray(driver.rollouts(plan, state))[..., :2]
            decisions.append(Decision(k, cells, path_from(xy), rollouts, watch.turning))
        assert task is not None and path_from is not None and field is not None
        clearances.append(float(_clearance(ROBOT, field, state, _UNKNOWN)))

        start = time.perf_counter()
        if watch.turning:
            control = _turn_on_the_spot(np.asarray(state))
        else:
            task = head(task, path_from, xy)
            control, plan, refused = driver.step(plan, state, task)
            refusals += int(refused)
        moved = np.asarray(motion(ROBOT, state, control))
        step_seconds.append(time.perf_counter() - start)
        state = jnp.asarray(moved[-1])
        states.append(moved[-1])
        passed.append(moved[:, :2])
        reached = bool(np.linalg.norm(moved[-1, :2] - problem.goal) < _REACHED)
        if reached:
            break
        if watch.looked_in_vain(moved[-1]):
            barred |= _bar(floor, path_from(moved[-1, :2]), decisions[-1].cells)

    assert field is not None
    clearances.append(float(_clearance(ROBOT, field, state, _UNKNOWN)))
    path = np.concatenate([problem.start[None, :2], *passed])
    exact = exact_clearance(model, ROBOT, path)
    exact = np.concatenate([exact[:1], exact[1:].reshape(len(passed), -1).min(axis=1)])
    first_drive = next((decision for decision in decisions if not decision.turning), decisions[-1])
    metrics = {
        "seed": seed,
        "unknown": _UNKNOWN,
        "from": problem.rooms[0],
        "to": problem.rooms[1],
        "start": problem.start.tolist(),
        "goal": problem.goal.tolist(),
        "goal_seen_from_start": bool(first_drive.cells.seen[floor.cell(problem.goal)]),
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
        problem, np.array(states), np.array(clearances), exact, decisions, floor, field, metrics
    )


class _Watch:
    """Decides when to look around: at the start, and whenever the robot is stuck."""

    def __init__(self, xy: np.ndarray) -> None:
        self.turning, self.places = True, [xy]
        self._turned = 0.0  # rad
        self._anchor, self._seconds = xy, 0.0  # it has stayed near the anchor for these seconds

    def looked_in_vain(self, state: np.ndarray) -> bool:
        """Records a control step; returns whether it is stuck where it looked around before."""
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


def _turn_on_the_spot(state: np.ndarray) -> jax.Array:
    turn = (ROBOT.max_turn_rate - state[4]) / ROBOT.step
    return jnp.asarray([-state[3] / ROBOT.step, turn])


def _bar(floor: Floor, path: np.ndarray, cells: Survey) -> np.ndarray:
    """Marks the cells just ahead on a path that the robot may not enter, (X, Y) bool."""
    barred = np.zeros(floor.shape, bool)
    near = np.linalg.norm(path - path[0], axis=1) < _BAR_AHEAD
    for xy in path[near]:
        i, j = floor.cell(xy)
        if not cells.seen[i, j]:
            barred[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = True
    return barred


_clearance = jax.jit(clearance, static_argnums=(0, 3))
