"""The check of a recorded pose, with a message that says where it stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hiosdf_jax._src.numerics.rigid import is_rigid


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
    if not is_rigid(matrix, np):
        raise ValueError(
            f"{source}: pose is not rigid, expected a rotation and a translation: {shown}"
        )
    return matrix.astype(np.float32)
