"""LiDAR sequences of the KITTI odometry benchmark, and SemanticKITTI.

- `velodyne/NNNNNN.bin`: float32 x y z reflectance, m; x forward, y left, z up.
- `calib.txt`: the line `Tr:` has the 12 numbers of T_camera_velodyne.
- `poses.txt` in the folder, or `../../poses/NAME.txt`: 12 numbers per line, T_world_camera of the
  left gray camera; line i is scan i.
- `times.txt`, if it is there: s; line i is the time of scan i.

The world is the first frame of that camera, so its y points down. Scans are used as recorded, with
the motion within a scan not corrected.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from hiosdf_jax._src.datasets.files import numbered_files, open_regular, read_lines, read_rows
from hiosdf_jax._src.datasets.stream import FrameStream, NoPosesError
from hiosdf_jax._src.numerics.intake import check_pose

_BYTES = 16  # per point


def kitti_stream(folder: str | os.PathLike[str], *, poses: bool = True) -> FrameStream:
    """Opens a sequence of the KITTI odometry benchmark.

    Args:
        folder: The folder of one sequence, such as `sequences/00`, with `velodyne` and
            `calib.txt`.
        poses: Whether to read the poses. If not, `calib.txt` is not needed either, and each pose is
            the identity.

    Returns:
        The scans as a stream. A scan that is cut off or has no pose is a bad frame.

    Raises:
        FileNotFoundError: A file or folder is missing.
        NoPosesError: There is no file of poses.
        ValueError: A file is malformed; the message names it and the line.

    Example:
        stream = datasets.kitti_stream("sequences/00")
        cloud, pose = stream[0]
    """
    folder = Path(folder).absolute()
    scans = numbered_files(folder / "velodyne", r"(\d+)\.bin")
    stamps = _stamps(folder / "times.txt", [number for number, _ in scans])
    if not poses:
        return FrameStream(
            folder, len(scans), lambda i: (_read_scan(scans[i][1]), np.eye(4)), stamps
        )
    path = _poses_file(folder)
    rows, lines = read_rows(path, 12)
    camera_from_sensor = _calibration(folder / "calib.txt")

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        number, scan = scans[index]
        if number >= len(rows):
            raise ValueError(f"{path}: {len(rows)} poses, none for {scan.name}")
        world_from_camera = check_pose(_square(rows[number]), f"{path}, line {lines[number]}")
        return _read_scan(scan), world_from_camera @ camera_from_sensor

    return FrameStream(folder, len(scans), frame, stamps)


def _poses_file(folder: Path) -> Path:
    inside, beside = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
    for path in (inside, beside):
        if path.is_file():
            return path
    raise NoPosesError(f"{folder}: has no poses, expected them in {inside.name} or {beside}")


def _stamps(path: Path, numbers: list[int]) -> list[float] | None:
    """Times of scans by their numbers, (F,) s."""
    if not path.is_file():
        return None
    times = read_rows(path, 1)[0][:, 0].tolist()
    return [times[number] if number < len(times) else math.nan for number in numbers]


def _read_scan(path: Path) -> np.ndarray:
    with open_regular(path) as file:
        content = file.read()
    if len(content) % _BYTES:
        raise ValueError(
            f"{path}: {len(content)} bytes, expected a multiple of {_BYTES}; is it cut off?"
        )
    return np.frombuffer(content, "<f4").reshape(-1, 4)[:, :3]


def _calibration(path: Path) -> np.ndarray:
    for line, text in read_lines(path):
        key, _, rest = text.partition(":")
        if key.strip() != "Tr":
            continue
        source = f"{path}, line {line}"
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        if len(values) != 12:
            raise ValueError(f"{source}: {len(values)} numbers, expected 12")
        return check_pose(_square(values), source)
    raise ValueError(f"{path}: no line 'Tr:', expected T_camera_velodyne there")


def _square(row: np.ndarray) -> np.ndarray:
    return np.concatenate([row.reshape(3, 4), [[0, 0, 0, 1]]])
