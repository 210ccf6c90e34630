"""Checks of a cloud and its pose, with the messages that users see."""

from __future__ import annotations

from typing import Any

import numpy as np

from hiosdf_jax._src.numerics.rigid import is_rigid


def check_shapes(cloud: Any, pose: Any) -> None:
    """Checks shapes only, which tracers have as well.

    Args:
        cloud: Expected (N, 3).
        pose: Expected (4, 4).

    Raises:
        ValueError: A shape is wrong.
    """
    _check_cloud_shape(cloud)
    _check_pose_shape(pose)


def check_pose(pose: Any, source: str = "") -> np.ndarray:
    """Checks that a pose is a rigid transform.

    Args:
        pose: (4, 4) T_world_sensor.
        source: Where the pose comes from, such as a file and a line. The message starts with it.

    Returns:
        (4, 4) float32, a copy of the pose.

    Raises:
        ValueError: The pose is misshapen, not finite or not rigid.
    """
    prefix = f"{source}: " if source else ""
    with np.errstate(over="ignore"):  # too large for float32 becomes inf, which is refused below
        matrix = np.array(pose, np.float32)
    _check_pose_shape(matrix, prefix)
    if not np.isfinite(matrix).all():
        raise ValueError(
            f"{prefix}pose has values that are not finite, expected T_world_sensor: "
            f"{_printed(matrix)}"
        )
    if not is_rigid(matrix, np):
        raise ValueError(
            f"{prefix}pose is not rigid, expected a rotation and a translation: {_printed(matrix)}"
        )
    return matrix


def finite_rows(cloud: Any) -> np.ndarray:
    """Finds the returns of a cloud.

    Args:
        cloud: (N, 3) m; a row with a NaN or inf is no return.

    Returns:
        (N,) bool, at least one of them True.

    Raises:
        ValueError: The cloud is misshapen or has no return.
    """
    _check_cloud_shape(cloud)
    x, y, z = np.asarray(cloud).T  # one column at a time is many times faster than all(axis=1)
    finite = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    if not finite.any():
        raise ValueError(
            f"cloud has no finite row among its {len(finite)}, expected at least one return"
        )
    return finite


def _check_cloud_shape(cloud: Any) -> None:
    if np.ndim(cloud) != 2 or np.shape(cloud)[1] != 3:
        raise ValueError(f"cloud has shape {np.shape(cloud)}, expected (N, 3)")


def _check_pose_shape(pose: Any, prefix: str = "") -> None:
    if np.shape(pose) != (4, 4):
        raise ValueError(f"{prefix}pose has shape {np.shape(pose)}, expected (4, 4)")


def _printed(matrix: np.ndarray) -> str:
    return np.array2string(matrix, precision=4, separator=", ")
