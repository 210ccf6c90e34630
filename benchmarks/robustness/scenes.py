"""The furnished room of the analytic scenarios, and the paths of its sensors."""

from __future__ import annotations

import numpy as np

from benchmarks.robustness.sensors import Sensor, look_at
from benchmarks.robustness.worlds import Box, Capsule, Room

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

_TARGET = np.array([3.8, 2.5, 0.9])
_RADIUS = 2.4  # m, from the sensor to the target
_HEIGHT = {"camera": 1.2, "lidar": 0.7}
_SWING = np.radians(35)
_PACE = 0.06  # rad of the swing's phase per scan: at most 9 cm, as at 0.9 m/s and 10 Hz


def facing_path(sensor: Sensor, scan: int) -> np.ndarray:
    """A sensor that swings around the middle of the room and faces it.

    Args:
        sensor: The sensor.
        scan: Number of the scan.

    Returns:
        (4, 4) T_world_sensor.
    """
    angle = _SWING * np.sin(_PACE * scan)
    position = _TARGET - _RADIUS * np.array([np.cos(angle), np.sin(angle), 0])
    position[2] = _HEIGHT[sensor.name]
    return look_at(position, _TARGET, sensor)
