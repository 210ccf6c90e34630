"""Scenarios of things that move all the time: a box, a person, and the robot's own arm."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

import hiosdf_jax as hio
from benchmarks.robustness import library, measures
from benchmarks.robustness.library import Frame, Setup
from benchmarks.robustness.scenes import ROOM, facing_path, frames_of, new_map, scan_all
from benchmarks.robustness.sensors import SENSORS, Scan, depth_camera
from benchmarks.robustness.worlds import Box, Capsule, Room, Thing, World

Rows = dict[str, measures.Figures]

_EMPTY_SCANS = 12
_MOVING_SCANS = 33
_MOVING_NUMBERS = range(_EMPTY_SCANS, _EMPTY_SCANS + _MOVING_SCANS)
_STEP = 0.1  # m per scan, 1 m/s at 10 Hz
_LAG = 3  # scans, 0.3 s

_ARM_SCANS = 40
_ARM_RADIUS = 0.05  # m
_SPHERE_EVERY, _SPHERE_RADIUS = 0.04, 0.06  # m, spheres that cover the arm
_POST = Capsule((1.98, 2.4, -1.0), (1.98, 2.4, 4.0), 0.04)


def cross(setup: Setup) -> Rows:
    """A box crosses the view at 10 cm per scan."""
    return _moving(setup, "crosses", lambda y: Box((3.8, y, 0.6), (0.25, 0.3, 0.6)))


def walk(setup: Setup) -> Rows:
    """A person-sized capsule crosses the view at 1 m/s, scanned at 10 Hz."""
    return _moving(setup, "walks", lambda y: Capsule((3.8, y, 0.25), (3.8, y, 1.5), 0.25))


def arm(setup: Setup) -> Rows:
    """The robot's own arm is in view all the time; its spheres are given."""
    sensor, numbers = depth_camera(), range(_ARM_SCANS)
    room = Room(ROOM.low, ROOM.high, ROOM.furniture)
    world = World(room, (_POST,))
    bare = scan_all(setup, sensor, lambda _: world, numbers)
    clean = library.play(new_map(setup), frames_of(bare), "arm: clean").state
    arms = [arm_at(k, facing_path(sensor, k)) for k in numbers]
    seen = scan_all(setup, sensor, lambda k: World(room, (_POST, *arms[k])), numbers)
    frames = [
        Frame(each.cloud, each.pose, robot=spheres_of(parts))
        for each, parts in zip(seen, arms, strict=True)
    ]
    played = library.play(new_map(setup), frames, "arm")
    points, truth = measures.seen_points(sensor, bare, world, setup.rng(1))
    swept = [part for parts in arms for part in parts]
    return {
        "arm in view": measures.ghosts(played.state, world, swept, setup.rng(2))
        | measures.kept(played.state, bare, [0])
        | measures.error_ratio(played.state, clean, points, truth)
        | measures.bounds_hold(played.state, points, truth)
    }


def arm_at(number: int, pose: np.ndarray) -> tuple[Capsule, Capsule]:
    """The arm of the robot that carries the camera, with its hand 30 to 55 cm in front.

    Args:
        number: Number of the scan.
        pose: (4, 4) T_world_camera.

    Returns:
        The upper arm and the forearm, world.
    """
    shoulder = np.array([0.0, 0.35, 0.15])
    hand = np.array(
        [
            0.3 * np.sin(0.5 * number),
            0.02 + 0.12 * np.sin(0.31 * number),
            0.42 + 0.1 * np.sin(0.23 * number),
        ]
    )
    elbow = (shoulder + hand) / 2 + [0.08, 0.06, 0.0]
    joints = np.stack([shoulder, elbow, hand]) @ pose[:3, :3].T + pose[:3, 3]
    first, second, third = ((float(joint[0]), float(joint[1]), float(joint[2])) for joint in joints)
    return Capsule(first, second, _ARM_RADIUS), Capsule(second, third, _ARM_RADIUS)


def spheres_of(parts: tuple[Capsule, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Spheres that cover some capsules: centers (k, 3) and radii (k,) m, k the same always."""
    count = 12
    centers = np.concatenate([np.linspace(part.start, part.end, count) for part in parts])
    return centers.astype(np.float32), np.full(len(centers), _SPHERE_RADIUS, np.float32)


def _moving(setup: Setup, verb: str, place: Callable[[float], Thing]) -> Rows:
    rows = {}
    things = [place(0.9 + _STEP * k) for k in range(_MOVING_SCANS)]
    worlds = [World(ROOM, (each,)) for each in things]
    for sensor in (make() for make in SENSORS.values()):
        name = f"{verb}, {sensor.name}"
        bare, empty, clean = _without_things(setup, sensor.name)
        seen = scan_all(setup, sensor, lambda k: worlds[k - _EMPTY_SCANS], _MOVING_NUMBERS)
        frames = frames_of(seen)
        wake = measures.Wake(things, _LAG, setup.rng(2))
        rows_called = measures.RowCounts()
        look = functools.partial(_look, wake, rows_called, worlds, seen)
        end = library.play(empty, frames, name, look).state
        points, truth = measures.seen_points(sensor, bare, World(ROOM), setup.rng(1))
        # The static map is scored where the thing, wherever it is now, is not the nearest.
        apart = worlds[-1].distance(points) == truth
        points, truth = points[apart], truth[apart]
        rows[name] = (
            wake.figures()
            | rows_called.figures()
            | measures.error_ratio(end, clean, points, truth)
            | measures.bounds_hold(end, points, truth)
        )
    return rows


@functools.lru_cache(maxsize=2)
def _without_things(
    setup: Setup, sensor_name: str
) -> tuple[list[Scan], hio.MapState, hio.MapState]:
    """Scans of the room alone, and the maps after the empty ones and after all of them."""
    sensor = SENSORS[sensor_name]()
    bare = scan_all(setup, sensor, lambda _: World(ROOM), range(_MOVING_NUMBERS.stop))
    name = f"room alone, {sensor_name}"
    empty = library.play(new_map(setup), frames_of(bare[:_EMPTY_SCANS]), name).state
    return bare, empty, library.play(empty, frames_of(bare[_EMPTY_SCANS:]), name).state


def _look(
    wake: measures.Wake,
    rows_called: measures.RowCounts,
    worlds: list[World],
    seen: list[Scan],
    index: int,
    before: hio.MapState,
    after: hio.MapState,
) -> None:
    wake.look(after, index, worlds[index], seen[index])
    frame = Frame(seen[index].cloud, seen[index].pose)
    rows_called.look(library.moving_rows(before, after, frame), seen[index])
