"""Poses with time stamps, and the interpolation between them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence

import numpy as np

from hiosdf_jax._src.datasets.files import read_rows

_NEAR = 0.02  # s; a pose this close to a stamp is used where there is nothing to interpolate
_UNIT_TOLERANCE = 0.01  # on the length of a quaternion; real ones are written with few digits


@dataclasses.dataclass(frozen=True)
class TimedPoses:
    """Poses of one frame in its parent, over time.

    Attributes:
        stamps: (F,) float64 s, never decreasing.
        positions: (F, 3) float64 m, in the parent frame.
        quaternions: (F, 4) float64, x y z w, of T_parent_child.
        source: Where the poses come from, for messages.
        lines: (F,) line numbers, if the source is a file.
    """

    stamps: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    source: str
    lines: Sequence[int] | None = None

    def place(self, index: int) -> str:
        """Names one pose, for messages."""
        if self.lines is None:
            return f"{self.source}, at {self.stamps[index]:.6f} s"
        return f"{self.source}, line {self.lines[index]}"


def read_timed_poses(path: str | os.PathLike[str]) -> TimedPoses:
    """Reads poses in TUM's format: `timestamp tx ty tz qx qy qz qw` on each line.

    Args:
        path: The file.

    Returns:
        The poses as they stand in the file; `pose_at` checks those that it uses.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: A line is malformed, a stamp is earlier than the one before it or repeats it
            with another pose, or the file has no pose.
    """
    rows, lines = read_rows(path, 8)
    if not len(rows):
        raise ValueError(f"{path}: has no pose, expected at least one")
    early = np.flatnonzero(~(np.diff(rows[:, 0]) >= 0))
    if len(early):
        i = early[0] + 1
        raise ValueError(
            f"{path}, line {lines[i]}: time {rows[i, 0]:.6f} s after {rows[i - 1, 0]:.6f} s, "
            "expected times that never decrease"
        )
    poses = TimedPoses(rows[:, 0], rows[:, 1:4], rows[:, 4:8], str(path), lines)
    check_unique(poses)
    return poses


def check_unique(poses: TimedPoses) -> None:
    """Checks that there is one pose at a time; it may be repeated.

    Args:
        poses: The poses.

    Raises:
        ValueError: Two poses at one time differ. The message names the source, and the lines if
            it is a file.
    """
    values = np.hstack([poses.positions, poses.quaternions])
    same = np.diff(poses.stamps) == 0
    twice = np.flatnonzero(same & (np.diff(values, axis=0) != 0).any(axis=1))
    if len(twice):
        i = twice[0] + 1
        than = "" if poses.lines is None else f" than in line {poses.lines[i - 1]}"
        raise ValueError(
            f"{poses.place(i)}: another pose at {poses.stamps[i]:.6f} s{than}, expected one pose "
            "at a time"
        )


def pose_at(poses: TimedPoses, stamp: float, max_gap: float) -> np.ndarray:
    """Interpolates poses: positions linearly, rotations along the great arc.

    Args:
        poses: The poses.
        stamp: s.
        max_gap: s; poses farther apart than this are not interpolated. A pose within 0.02 s of the
            stamp is used as it is.

    Returns:
        (4, 4) float64, T_parent_child.

    Raises:
        ValueError: No pose is close enough to the stamp, or the poses there are not finite or have
            no unit quaternion. The message names the source, and the line if it is a file.
    """
    from scipy.spatial.transform import Rotation, Slerp

    stamps = poses.stamps
    rows = rows_at(poses, stamp, max_gap)
    if not rows:
        raise ValueError(
            f"{poses.source}: no pose for {stamp:.6f} s; the nearest is "
            f"{np.abs(stamps - stamp).min():.3f} s away, expected one within {_NEAR} s, or poses "
            f"on both sides at most {max_gap} s apart"
        )
    positions, rotations = zip(*(_checked(poses, i) for i in rows), strict=True)
    position, rotation = positions[0], rotations[0]
    if len(rows) == 2:
        share = (stamp - stamps[rows[0]]) / np.ptp(stamps[rows])
        position = (1 - share) * positions[0] + share * positions[1]
        rotation = Slerp([0, 1], Rotation.concatenate(rotations))(share)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def rows_at(poses: TimedPoses, stamp: float, max_gap: float) -> list[int]:
    """Finds the poses that `pose_at` uses for a time.

    Args:
        poses: The poses.
        stamp: s.
        max_gap: s, as for `pose_at`.

    Returns:
        Indices: of the two poses to interpolate, of one that is used as it is, or none.
    """
    stamps = poses.stamps
    after = int(np.searchsorted(stamps, stamp))
    around = [i for i in (after - 1, after) if 0 <= i < len(stamps)]
    nearest = min(around, key=lambda i: abs(stamps[i] - stamp))
    if len(around) == 2 and stamps[nearest] != stamp and np.ptp(stamps[around]) <= max_gap:
        return around
    return [nearest] if abs(stamps[nearest] - stamp) <= _NEAR else []


def _checked(poses: TimedPoses, index: int):  # noqa: ANN202, scipy is imported when used
    """The position and the rotation of one pose."""
    from scipy.spatial.transform import Rotation

    position, quaternion = poses.positions[index], poses.quaternions[index]
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise ValueError(f"{poses.place(index)}: pose has values that are not finite")
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise ValueError(f"{poses.place(index)}: quaternion has length {length:.4g}, expected 1")
    return position, Rotation.from_quat(quaternion)
