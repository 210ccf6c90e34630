"""Writes trajectories in TUM's format, which `timed_poses` reads."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from hiosdf_jax._src.numerics.intake import as_real
from hiosdf_jax._src.numerics.rigid import is_rigid_on_host
from hiosdf_jax._src.output_files import replacing


def write_tum(path: str | os.PathLike[str], stamps: Any, poses: Any) -> None:
    """Writes poses in TUM's format: `timestamp tx ty tz qx qy qz qw` on each line.

    Example:
        >>> datasets.write_tum("poses.txt", stamps, poses)

    Args:
        path: The file.
        stamps: (F,) s, increasing.
        poses: (F, 4, 4) T_world_sensor, rigid; written as float64 to the last digit.

    Raises:
        ValueError: A shape or a value is wrong.
        OSError: The file cannot be written.
    """
    stamps, poses = as_real("stamps", stamps).astype(float), as_real("poses", poses).astype(float)
    if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
        raise ValueError(
            f"stamps has shape {stamps.shape} and poses {poses.shape}, expected (F,) and (F, 4, 4)"
        )
    if not np.isfinite(stamps).all() or not (np.diff(stamps) > 0).all():
        raise ValueError("stamps is not finite and increasing, expected seconds that increase")
    wrong = [i for i, pose in enumerate(poses) if not is_rigid_on_host(pose)]
    if wrong:
        raise ValueError(f"poses[{wrong[0]}] is not rigid, expected a rotation and a translation")
    from scipy.spatial.transform import Rotation

    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, pose in zip(stamps, poses, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(" ".join(repr(float(each)) for each in (stamp, *pose[:3, 3], *turn)))
    with replacing(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
