"""The frame of pictures from above: the world, or a leveled one if the world is tilted."""

from __future__ import annotations

import numpy as np

_TILTED = np.radians(2)  # a world whose z is farther than this from upward is leveled


def is_tilted(up_world: np.ndarray) -> bool:
    """Returns whether the world's z axis does not point up, by `up_world` (3,), a unit vector."""
    return bool(up_world[2] < np.cos(_TILTED))


def world_from_level(up_world: np.ndarray) -> np.ndarray:
    """Finds the smallest rotation that levels a tilted world.

    Args:
        up_world: (3,) unit vector against gravity.

    Returns:
        (3, 3); the identity if the world's z axis points up.
    """
    if not is_tilted(up_world):
        return np.eye(3)
    x, y, z = up_world
    if z < -1 + 1e-6:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + z)
