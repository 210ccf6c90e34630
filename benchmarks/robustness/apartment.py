"""Scenarios in the demo's MuJoCo apartment: a door, a chair, a person and the robot's arm."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import functools

import mujoco
import numpy as np

import hiosdf_jax as hio
from benchmarks.robustness import library, measures
from benchmarks.robustness.library import Frame, Setup
from benchmarks.robustness.movers import arm_at, spheres_of
from benchmarks.robustness.scenes import frames_of, scan_all
from benchmarks.robustness.sensors import Scan, Sensor, depth_camera, look_at
from benchmarks.robustness.worlds import Box, Capsule, Thing, World
from hiosdf_jax import demo
from hiosdf_jax._src.demo.camera import cast_rays

Rows = dict[str, measures.Figures]

_MAX_RANGE = 6.0  # m
_SCANS = 60
_SCANS_AFTER = 5
_CHAIR_MOVES = 12  # scan
_DOOR_OPENS = range(18, 23)  # scans, 18 degrees each
_WALK = range(32, 57)  # scans, 0.1 m each
_LAG = 3  # scans, 0.3 s
_ARM_SCANS = 40
_LEAST_TRUTH = 0.2  # m; in the middle of the doorway, and above the floor

_HINGE = (5.65, 0.85)
_CHAIR_BEFORE, _CHAIR_AFTER = (4.4, 0.6), (4.6, 2.7)


class Apartment:
    """The demo's apartment as a background."""

    def __init__(self) -> None:
        """Loads the model."""
        self._model = demo.load_model()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Ranges (n,) m along unit directions (n, 3); inf where a ray hits nothing."""
        ranges, _ = cast_rays(self._model, self._data, origin, directions)
        return np.where(ranges < 0, np.inf, ranges)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (n,) m at points (n, 3) m, positive in free space."""
        return demo.signed_distance(self._model, points)[0]


def visit(setup: Setup) -> Rows:
    """A chair is moved, a door opens, and a person walks through the living room."""
    sensor, apartment = depth_camera(), Apartment()
    seen = scan_all(setup, sensor, lambda k: world_at(apartment, k), range(_SCANS), _path)
    bare, _, clean = _still(setup)
    state, rows = _new_map(setup), {}

    frames = frames_of(seen)
    chair_seen = _CHAIR_MOVES + _SCANS_AFTER
    state = library.play(state, frames[:chair_seen], "apartment: chair").state
    world = world_at(apartment, chair_seen)
    chair = range(1, 1 + len(chair_at(_CHAIR_AFTER)))
    place = measures.draw_old_place(world, chair_at(_CHAIR_BEFORE), setup.rng(1), _LEAST_TRUTH)
    rows["apartment: chair moved"] = measures.old_place(state, *place) | measures.visible_side(
        state, seen[_CHAIR_MOVES:chair_seen], chair
    )

    door_seen = _DOOR_OPENS.stop + _SCANS_AFTER
    state = library.play(state, frames[chair_seen:door_seen], "apartment: door").state
    world = world_at(apartment, door_seen)
    place = measures.draw_old_place(world, [door_at(0)], setup.rng(1), _LEAST_TRUTH)
    rows["apartment: door opens"] = measures.old_place(state, *place)

    state = library.play(state, frames[door_seen : _WALK.start], "apartment: door").state
    people = [person_at(k) for k in _WALK]
    wake = measures.Wake(people, _LAG, setup.rng(2))
    rows_called = measures.RowCounts()

    def look(index: int, before: hio.MapState, after: hio.MapState) -> None:
        k = _WALK.start + index
        wake.look(after, index, world_at(apartment, k), seen[k])
        rows_called.look(library.moving_rows(before, after, frames[k]), seen[k])

    walking = slice(_WALK.start, _WALK.stop)
    state = library.play(state, frames[walking], "apartment: person", look).state
    state = library.play(state, frames[_WALK.stop :], "apartment: person").state
    rows["apartment: person walks"] = wake.figures() | rows_called.figures()
    rows["apartment: at the end"] = _against(setup, bare, state, clean)
    return rows


def arm(setup: Setup) -> Rows:
    """The robot's own arm is in view all the time; its spheres are given."""
    sensor, apartment = depth_camera(), Apartment()
    world = _end(apartment)
    arms = [arm_at(k, _path(sensor, k)) for k in range(_ARM_SCANS)]
    bare, clean, _ = _still(setup)
    seen = scan_all(
        setup,
        sensor,
        lambda k: World(apartment, (*world.things, *arms[k])),
        range(_ARM_SCANS),
        _path,
    )
    frames = [
        Frame(each.cloud, each.pose, robot=spheres_of(parts))
        for each, parts in zip(seen, arms, strict=True)
    ]
    state = library.play(_new_map(setup), frames, "apartment: arm").state
    swept = [part for parts in arms for part in parts]
    return {
        "apartment: arm in view": measures.ghosts(state, world, swept, setup.rng(2))
        | _against(setup, bare[:_ARM_SCANS], state, clean)
    }


def world_at(apartment: Apartment, number: int) -> World:
    """The world at a scan.

    Args:
        apartment: What stands still.
        number: Number of the scan.

    Returns:
        The person, if it is there, else something out of sight; then the chair; then the door.
    """
    chair = chair_at(_CHAIR_BEFORE if number < _CHAIR_MOVES else _CHAIR_AFTER)
    return World(apartment, (person_at(number), *chair, door_at(number)))


def person_at(number: int) -> Capsule:
    """The person at a scan; below the floor when it is not there."""
    y = 0.6 + 0.1 * (number - _WALK.start)
    below = 0.0 if number in _WALK else -50.0
    return Capsule((3.5, y, below + 0.25), (3.5, y, below + 1.5), 0.25)


def door_at(number: int) -> Box:
    """The door to the kitchen at a scan: it opens by 18 degrees per scan."""
    opened = np.clip(number - _DOOR_OPENS.start + 1, 0, len(_DOOR_OPENS)) / len(_DOOR_OPENS)
    yaw = float(np.pi / 2 * (1 - opened))
    x, y = _HINGE
    reach = 0.475
    center = (x + reach * float(np.cos(yaw)), y + reach * float(np.sin(yaw)), 1.02)
    return Box(center, (reach - 0.01, 0.02, 1.0), yaw)


def chair_at(place: tuple[float, float]) -> tuple[Thing, ...]:
    """A chair with a seat, a back and four legs."""
    x, y = place
    legs = [
        Box((x + dx, y + dy, 0.215), (0.025, 0.025, 0.215))
        for dx in (-0.2, 0.2)
        for dy in (-0.2, 0.2)
    ]
    seat = Box((x, y, 0.455), (0.23, 0.23, 0.025))
    back = Box((x + 0.205, y, 0.7), (0.025, 0.23, 0.22))
    return (seat, back, *legs)


def _path(sensor: Sensor, number: int) -> np.ndarray:
    """A camera that sways in the living room and faces the door to the kitchen."""
    sway = np.sin(0.12 * number)
    return look_at(np.array([1.8, 1.5 + 0.35 * sway, 1.2]), np.array([4.6, 1.5, 0.8]), sensor)


@functools.lru_cache(maxsize=1)
def _still(setup: Setup) -> tuple[list[Scan], hio.MapState, hio.MapState]:
    """Scans of the apartment as it is at the end, and the maps after `_ARM_SCANS` and after all."""
    world = _end(Apartment())
    bare = scan_all(setup, depth_camera(), lambda _: world, range(_SCANS), _path)
    frames = frames_of(bare)
    early = library.play(_new_map(setup), frames[:_ARM_SCANS], "apartment: still").state
    return bare, early, library.play(early, frames[_ARM_SCANS:], "apartment: still").state


def _end(apartment: Apartment) -> World:
    """The world when all has happened."""
    return World(apartment, (*chair_at(_CHAIR_AFTER), door_at(_SCANS)))


def _against(
    setup: Setup, bare: list[Scan], state: hio.MapState, clean: hio.MapState
) -> measures.Figures:
    points, truth = measures.seen_points(depth_camera(), bare, _end(Apartment()), setup.rng(1))
    return measures.error_ratio(state, clean, points, truth) | measures.bounds_hold(
        state, points, truth
    )


def _new_map(setup: Setup) -> hio.MapState:
    return setup.new_map(setup.config(demo.BOUNDS_WORLD, _MAX_RANGE))
