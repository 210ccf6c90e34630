"""Frames of a ScanNet scene, as exported by its SensReader.

- `depth/N.png`: 16 bits, mm along the optical axis; x right, y down, z forward.
- `pose/N.txt`: 4 lines of 4 numbers, T_world_camera; -inf where tracking was lost. N is written as
  in the image's name, or without its leading zeros.
- `intrinsic/intrinsic_depth.txt`: 4 lines of 4 numbers, K in the upper left.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np

from hiosdf_jax._src.datasets.depth import read_depth
from hiosdf_jax._src.datasets.files import numbered_files, read_rows
from hiosdf_jax._src.datasets.sensors import check_camera
from hiosdf_jax._src.datasets.stream import FrameStream, check_has_poses
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
        ValueError: A file is malformed, and the message names it and the line; or a frame has two
            images.

    Example:
        stream = datasets.scannet_stream("scene0000_00")
        cloud, pose = stream[0]
    """
    folder = Path(folder)
    images = numbered_files(folder / "depth", r"(\d+)\.png")
    _check_once(images)
    if poses:
        check_has_poses(folder / "pose", "the folder pose")
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    matrix = _matrix(path)[:3, :3]
    check_camera(f"{path}: camera matrix", matrix)

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        pose = np.eye(4)
        if poses:
            source = _pose_file(folder / "pose", *images[index])
            pose = check_pose(_matrix(source), str(source))
        return read_depth(images[index][1], _SCALE, matrix), pose

    return FrameStream(folder, len(images), frame)


def _check_once(images: list[tuple[int, Path]]) -> None:
    """Raises if one frame has two images, such as 1.png and 01.png."""
    for (number, image), (other, twin) in itertools.pairwise(images):
        if number == other:
            raise ValueError(
                f"{image}: is frame {number}, as is {twin.name}, expected one image per frame"
            )


def _pose_file(folder: Path, number: int, image: Path) -> Path:
    """The file of an image's pose; where there is none, the name that it should have."""
    path, plain = folder / f"{image.stem}.txt", folder / f"{number}.txt"
    return plain if plain.is_file() and not path.exists() else path


def _matrix(path: Path) -> np.ndarray:
    rows, _ = read_rows(path, 4)
    if len(rows) != 4:
        raise ValueError(f"{path}: {len(rows)} lines, expected 4")
    return rows
