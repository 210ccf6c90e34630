"""Frames of a ScanNet scene, as exported by its SensReader.

- `depth/N.png`: 16 bits, mm along the optical axis; x right, y down, z forward.
- `pose/N.txt`: 4 lines of 4 numbers, T_world_camera; -inf where tracking was lost.
- `intrinsic/intrinsic_depth.txt`: 4 lines of 4 numbers, K in the upper left.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hiosdf_jax._src.datasets.depth import pinhole, read_depth
from hiosdf_jax._src.datasets.files import numbered_files, read_rows
from hiosdf_jax._src.datasets.stream import FrameStream, NoPosesError
from hiosdf_jax._src.numerics.intake import check_pose

_SCALE = 1000.0  # depth is in mm


def scannet_stream(folder: str | os.PathLike[str], *, poses: bool = True) -> FrameStream:
    """Opens the exported frames of a ScanNet scene.

    Args:
        folder: The folder with `depth`, `pose` and `intrinsic`.
        poses: Whether to read `pose`. If not, each pose is the identity.

    Returns:
        The depth images as a stream. An image without a pose, or with ScanNet's -inf, is a bad
        frame.

    Raises:
        FileNotFoundError: A file or folder is missing.
        NoPosesError: There is no folder `pose`.
        ValueError: A file is malformed; the message names it and the line.

    Example:
        stream = datasets.scannet_stream("scene0000_00")
        cloud, pose = stream[0]
    """
    folder = Path(folder)
    images = numbered_files(folder / "depth", r"(\d+)\.png")
    if poses and not (folder / "pose").exists():
        raise NoPosesError(f"{folder}: has no poses, expected them in the folder pose")
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    values = _matrix(path)
    matrix = pinhole([values[0, 0], values[1, 1], values[0, 2], values[1, 2]], path)

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        number, image = images[index]
        source = folder / "pose" / f"{number}.txt"
        pose = check_pose(_matrix(source), str(source)) if poses else np.eye(4)
        return read_depth(image, _SCALE, matrix), pose

    return FrameStream(folder, len(images), frame)


def _matrix(path: Path) -> np.ndarray:
    rows, _ = read_rows(path, 4)
    if len(rows) != 4:
        raise ValueError(f"{path}: {len(rows)} lines, expected 4")
    return rows
