"""What makes a recorded pose usable: finite, and rigid to the digits that it was written with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# On R^T R - I: real trajectories are written with few digits. The same as an update's.
_RIGID_TOLERANCE = 5e-3


def check_pose(pose: ArrayLike, source: str) -> np.ndarray:
    """Refuses what is not a rigid transform.

    Args:
        pose: (4, 4) T_world_sensor.
        source: Where it comes from, such as a file and a line; the message begins with it.

    Returns:
        (4, 4) float32, the pose.

    Raises:
        ValueError: The pose is misshapen, not finite or not rigid.
    """
    matrix = np.asarray(pose, float)
    if matrix.shape != (4, 4):
        raise ValueError(f"{source}: pose has shape {matrix.shape}, expected (4, 4)")
    shown = np.array2string(matrix, precision=4, separator=", ")
    if not np.isfinite(matrix).all():
        raise ValueError(
            f"{source}: pose has values that are not finite, expected T_world_sensor: {shown}"
        )
    rotation = matrix[:3, :3]
    orthonormal = np.abs(rotation.T @ rotation - np.eye(3)).max() <= _RIGID_TOLERANCE
    last_row = np.abs(matrix[3] - [0, 0, 0, 1]).max() <= 1e-6
    if not (orthonormal and last_row and np.linalg.det(rotation) > 0):
        raise ValueError(
            f"{source}: pose is not rigid, expected a rotation and a translation: {shown}"
        )
    return matrix.astype(np.float32)
