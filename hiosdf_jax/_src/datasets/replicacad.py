"""Sequences in the layout of iSDF's ReplicaCAD and of NICE-SLAM's Replica.

- `traj.txt`: 16 numbers per line, T_world_camera row by row; line i is frame i.
- `results/depthNNNNNN.png`: 16 bits, depth along the optical axis; x right, y down, z forward.
- `replicaCAD_info.json` (iSDF) or `cam_params.json` (NICE-SLAM), in the folder or its parent:
  `camera` with w, h, fx, fy, cx, cy; `depth_scale`, or `scale` in `camera`: m = value / scale.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from hiosdf_jax._src.datasets.depth import pinhole, read_depth
from hiosdf_jax._src.datasets.files import numbered_files, open_regular, parsing, read_rows
from hiosdf_jax._src.datasets.stream import FrameStream, check_has_poses
from hiosdf_jax._src.numerics.intake import as_number, check_pose

_INFO = ("replicaCAD_info.json", "cam_params.json")


def replicacad_stream(folder: str | os.PathLike[str], *, poses: bool = True) -> FrameStream:
    """Opens a sequence in the layout of iSDF's ReplicaCAD or NICE-SLAM's Replica.

    Args:
        folder: The folder with `traj.txt` and `results`.
        poses: Whether to read `traj.txt`. If not, each pose is the identity.

    Returns:
        The depth images as a stream. An image without a usable pose is a bad frame.

    Raises:
        FileNotFoundError: A file or folder is missing.
        NoPosesError: There is no `traj.txt`.
        ValueError: A file is malformed; the message names it and the line.

    Example:
        stream = datasets.replicacad_stream("apt_2_nav")
        cloud, pose = stream[0]
    """
    folder = Path(folder)
    images = numbered_files(folder / "results", r"depth(\d+)\.png")
    path = folder / "traj.txt"
    if poses:
        check_has_poses(path, path.name)
    rows, lines = read_rows(path, 16) if poses else ((), ())
    matrix, scale, size = _camera(folder)

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        number, image = images[index]
        if not poses:
            return read_depth(image, scale, matrix, size), np.eye(4)
        if number >= len(rows):
            raise ValueError(f"{path}: {len(rows)} poses, none for {image.name}")
        pose = check_pose(rows[number].reshape(4, 4), f"{path}, line {lines[number]}")
        return read_depth(image, scale, matrix, size), pose

    return FrameStream(folder, len(images), frame)


def _camera(folder: Path) -> tuple[np.ndarray, float, tuple[int, int]]:
    """Returns K, the depth scale, and (width, height)."""
    candidates = [place / name for place in (folder, folder.absolute().parent) for name in _INFO]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        raise ValueError(f"{folder}: neither it nor its parent folder has one of {list(_INFO)}")
    with open_regular(path) as file, parsing(path, "JSON file"):
        info: dict[str, Any] = json.loads(file.read().decode("utf-8"))
    try:
        camera = info["camera"]
        scale = as_number(
            "scale", info["depth_scale"] if "depth_scale" in info else camera["scale"]
        )
        values = [as_number(key, camera[key]) for key in ("fx", "fy", "cx", "cy")]
        size = int(as_number("w", camera["w"])), int(as_number("h", camera["h"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: {error!r}, expected numbers depth_scale (or camera.scale) and camera.w, h, "
            "fx, fy, cx, cy"
        ) from error
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"{path}: depth scale is {scale}, expected > 0")
    return pinhole(values, path), scale, size
