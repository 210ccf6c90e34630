"""Sequences of the TUM RGB-D benchmark, and others in its layout.

- `depth.txt`: `timestamp filename` on each line.
- the images: 16-bit PNG, m = value / 5000 along the optical axis; x right, y down, z forward.
- `groundtruth.txt`: `timestamp tx ty tz qx qy qz qw`, T_world_camera, s and m.

Poses are interpolated at the time of the image. Lens distortion is not corrected: the depth is
registered to the color image, and the authors of the benchmark advise against it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hiosdf_jax._src.datasets.depth import pinhole, read_depth
from hiosdf_jax._src.datasets.files import read_words
from hiosdf_jax._src.datasets.stream import FrameStream, check_has_poses
from hiosdf_jax._src.datasets.timed_poses import pose_at, read_timed_poses

_SCALE = 5000.0
_MAX_GAP = 0.2  # s; motion capture gives 100 poses per second while it sees the camera
_SIZE = (640, 480)
# fx, fy, cx, cy of the color cameras, to which the depth is registered; from the benchmark's site.
_FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}


def tum_stream(
    folder: str | os.PathLike[str],
    intrinsics: Sequence[float] | None = None,
    *,
    poses: bool = True,
) -> FrameStream:
    """Opens a sequence in the layout of the TUM RGB-D benchmark.

    Args:
        folder: The folder with `depth.txt` and `groundtruth.txt`.
        intrinsics: fx, fy, cx, cy in pixels; by default those of the benchmark's camera that the
            folder is named after (freiburg1, 2 or 3).
        poses: Whether to read `groundtruth.txt`. If not, each pose is the identity.

    Returns:
        The depth images as a stream. An image without a pose at its time is a bad frame.

    Raises:
        FileNotFoundError: A file is missing.
        NoPosesError: There is no `groundtruth.txt`.
        ValueError: A file is malformed, and the message names it and the line; or the camera is
            unknown.

    Example:
        stream = datasets.tum_stream("desk", intrinsics=(517.3, 516.5, 318.6, 255.3))
        cloud, pose = stream[0]
    """
    folder = Path(folder)
    images = []
    for line, (stamp, name) in read_words(folder / "depth.txt", 2):
        try:
            images.append((float(stamp), folder / name))
        except ValueError as error:
            raise ValueError(f"{folder / 'depth.txt'}, line {line}: {error}") from error
    if not images:
        raise ValueError(f"{folder / 'depth.txt'}: has no image, expected at least one")
    path = folder / "groundtruth.txt"
    if poses:
        check_has_poses(path, path.name)
    trajectory = read_timed_poses(path) if poses else None
    size = None
    if intrinsics is None:
        found = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder.absolute().name)
        if not found:
            raise ValueError(
                f"{folder}: unknown camera, expected intrinsics or a folder named after "
                "freiburg1, freiburg2 or freiburg3"
            )
        intrinsics, size = _FREIBURG[found[1]], _SIZE
    matrix = pinhole(intrinsics, folder)

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        stamp, image = images[index]
        pose = np.eye(4) if trajectory is None else pose_at(trajectory, stamp, _MAX_GAP)
        return read_depth(image, _SCALE, matrix, size), pose

    return FrameStream(folder, len(images), frame, [stamp for stamp, _ in images])
