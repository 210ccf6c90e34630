"""LiDAR sequences of the KITTI odometry benchmark, and SemanticKITTI.

- `velodyne/NNNNNN.bin`: float32 x y z reflectance, m; x forward, y left, z up.
- `calib.txt`: the line `Tr:` has the 12 numbers of T_camera_velodyne.
- `poses.txt` in the folder, or `../../poses/NAME.txt`: 12 numbers per line, T_world_camera of the
  left gray camera; line i is scan i.

The world is the first frame of that camera, so its y points down. Scans are used as recorded, with
the motion within a scan not corrected.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hiosdf_jax._src.datasets.files import numbered_files, open_regular, read_lines, read_rows
from hiosdf_jax._src.datasets.stream import FrameStream
from hiosdf_jax._src.numerics.intake import check_pose

_BYTES = 16  # per point


def kitti_stream(folder: str | os.PathLike[str]) -> FrameStream:
    """Opens a sequence of the KITTI odometry benchmark.

    Args:
        folder: The folder of one sequence, such as `sequences/00`, with `velodyne` and
            `calib.txt`.

    Returns:
        The scans as a stream. A scan that is cut off or has no pose is a bad frame.

    Raises:
        FileNotFoundError: A file or folder is missing.
        ValueError: A file is malformed; the message names it and the line.

    Example:
        stream = datasets.kitti_stream("sequences/00")
        cloud, pose = stream[0]
    """
    folder = Path(folder).absolute()
    scans = numbered_files(folder / "velodyne", r"(\d+)\.bin")
    path = folder / "poses.txt"
    if not path.is_file():
        path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    rows, lines = read_rows(path, 12)
    camera_from_sensor = _calibration(folder / "calib.txt")

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        number, scan = scans[index]
        if number >= len(rows):
            raise ValueError(f"{path}: {len(rows)} poses, none for {scan.name}")
        world_from_camera = check_pose(_square(rows[number]), f"{path}, line {lines[number]}")
        return _read_scan(scan), world_from_camera @ camera_from_sensor

    return FrameStream(folder, len(scans), frame)


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
