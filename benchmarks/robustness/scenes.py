"""The furnished room of the analytic scenarios, and the paths of its sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

import hiosdf_jax as hio
from benchmarks.robustness.library import Frame, Setup
from benchmarks.robustness.sensors import Scan, Sensor, look_at, scan
from benchmarks.robustness.worlds import Box, Capsule, Room, World

# One box and one range for all analytic scenarios: each configuration compiles once.
BOUNDS = ((-0.2, -0.2, -0.2), (6.2, 5.2, 2.8))  # m
MAX_RANGE = 9.0  # m, more than the room's diagonal

ROOM = Room(
    low=(0.0, 0.0, 0.0),
    high=(6.0, 5.0, 2.6),
    furniture=(
        Box((5.7, 1.0, 0.9), (0.3, 0.6, 0.9)),  # cabinet
        Box((2.0, 4.6, 0.25), (1.0, 0.4, 0.25)),  # sofa
        Capsule((5.0, 4.2, -1.0), (5.0, 4.2, 4.0), 0.15),  # pillar
        Box((2.6, 0.4, 0.72), (0.7, 0.4, 0.03)),  # table top
        Box((2.0, 0.4, 0.345), (0.04, 0.35, 0.345)),  # its legs
        Box((3.2, 0.4, 0.345), (0.04, 0.35, 0.345)),
    ),
)

TOUR = 60  # scans
_TARGET = np.array([3.8, 2.5, 0.9])
_RADIUS = 2.4  # m, from the sensor to the target
_HEIGHT = {"camera": 1.2, "lidar": 0.7}
_SWING = np.radians(35)
_PACE = 0.06  # rad of the swing's phase per scan: at most 9 cm, as at 0.9 m/s and 10 Hz


def facing_path(sensor: Sensor, number: int) -> np.ndarray:
    """A sensor that swings around the middle of the room and faces it.

    Args:
        sensor: The sensor.
        number: Number of the scan.

    Returns:
        (4, 4) T_world_sensor.
    """
    angle = _SWING * np.sin(_PACE * number)
    position = _TARGET - _RADIUS * np.array([np.cos(angle), np.sin(angle), 0])
    position[2] = _HEIGHT[sensor.name]
    return look_at(position, _TARGET, sensor)


def touring_path(sensor: Sensor, number: int) -> np.ndarray:
    """A sensor that goes around the room once and looks outward.

    Args:
        sensor: The sensor.
        number: Number of the scan, less than `TOUR`.

    Returns:
        (4, 4) T_world_sensor.
    """
    angle = 2 * np.pi * number / TOUR
    position = np.array([3.2 + 1.2 * np.cos(angle), 2.4 + 0.9 * np.sin(angle), 1.2])
    gaze = angle + np.radians(50)
    return look_at(position, position + np.array([np.cos(gaze), np.sin(gaze), -0.2]), sensor)


def scan_all(
    setup: Setup,
    sensor: Sensor,
    world_at: Callable[[int], World],
    numbers: Iterable[int],
    path: Callable[[Sensor, int], np.ndarray] = facing_path,
) -> list[Scan]:
    """Scans a world that may change from scan to scan.

    Args:
        setup: Source of randomness.
        sensor: The sensor.
        world_at: The world at each scan.
        numbers: Numbers of the scans.
        path: Pose of the sensor at each scan.

    Returns:
        The scans.
    """
    return [scan(sensor, world_at(k), path(sensor, k), setup.rng(0, k)) for k in numbers]


def frames_of(scans: Iterable[Scan]) -> list[Frame]:
    """The scans as updates, without robot and noise."""
    return [Frame(each.cloud, each.pose) for each in scans]


def new_map(setup: Setup) -> hio.MapState:
    """An empty map of the room."""
    return setup.new_map(setup.config(BOUNDS, MAX_RANGE))
