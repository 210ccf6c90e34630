"""Opens a recorded stream in any format, recognized by its file or folder.

Each format is a function that returns a `Stream`, the protocol in `stream.py`. To add one, write
the function in a module of its own and list it here.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

from hiosdf_jax._src.datasets.clouds import cloud_stream
from hiosdf_jax._src.datasets.kitti import kitti_stream
from hiosdf_jax._src.datasets.npz import NpzStream
from hiosdf_jax._src.datasets.replicacad import replicacad_stream
from hiosdf_jax._src.datasets.rosbag import rosbag_stream
from hiosdf_jax._src.datasets.scannet import scannet_stream
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.datasets.tum import tum_stream


class _Format(NamedTuple):
    open: Callable[..., Stream]
    sign: str  # how to recognize it, in words
    fits: Callable[[Path], bool]


def _holds(*names: str) -> Callable[[Path], bool]:
    return lambda path: all((path / name).exists() for name in names)


def _is_bag(path: Path) -> bool:
    return path.is_file() and path.suffix in (".bag", ".mcap", ".db3")


def _clouds_in(path: Path) -> set[str]:
    return {each.name for each in path.iterdir() if each.suffix.lower() in (".ply", ".pcd")}


def _has_clouds(path: Path) -> bool:
    return path.is_dir() and bool(_clouds_in(path))


_FORMATS = {
    "npz": _Format(NpzStream, "a file .npz", lambda path: path.is_file() and path.suffix == ".npz"),
    "replicacad": _Format(
        replicacad_stream, "a folder with traj.txt, results", _holds("traj.txt", "results")
    ),
    "scannet": _Format(scannet_stream, "with depth, intrinsic", _holds("depth", "intrinsic")),
    "tum": _Format(tum_stream, "with depth.txt", _holds("depth.txt")),
    "kitti": _Format(kitti_stream, "with velodyne", _holds("velodyne")),
    "clouds": _Format(cloud_stream, "with *.ply or *.pcd", _has_clouds),
    "rosbag": _Format(
        rosbag_stream,
        "with metadata.yaml, or a file .bag, .mcap, .db3",
        lambda path: _is_bag(path) or (path / "metadata.yaml").exists(),
    ),
}

FORMATS = tuple(_FORMATS)


def holds_recording(folder: Path, apart: Collection[str] = ()) -> bool:
    """Whether a reader takes a folder for a stream, which another file would spoil.

    Args:
        folder: The folder.
        apart: Names of files that do not count as clouds, such as meshes.

    Returns:
        Whether one does.
    """
    others = (each.fits(folder) for name, each in _FORMATS.items() if name != "clouds")
    return any(others) or bool(_clouds_in(folder) - set(apart))


def open_stream(
    path: str | os.PathLike[str],
    format: str | None = None,
    *,
    poses: bool = True,
    **options: Any,
) -> Stream:
    """Opens a recorded stream in any format that has a reader.

    Example:
        stream = open_stream("rgbd_dataset_freiburg1_desk")
        for cloud, pose in stream:
            state = hio.update(state, cloud, pose)

    Args:
        path: The file or folder.
        format: One of `FORMATS`; by default recognized from the file or folder.
        poses: Whether to read the poses. If not, each pose is the identity, and the recording needs
            none.
        **options: Options of the format's reader: `intrinsics` for tum, `trajectory` for clouds,
            `cloud_topic`, `odometry_topic` and `world_frame` for rosbag.

    Returns:
        The frames, read one at a time.

    Raises:
        FileNotFoundError: The path, or a file in it, does not exist.
        NoPosesError: The recording has no poses.
        ValueError: The format is unknown or ambiguous, has no such option, or a file is malformed.
        ModuleNotFoundError: The format needs a package that is not installed.
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path is a {type(path).__name__}, expected the name of a file or folder")
    path = Path(path)
    path.stat()
    if format is None:
        fitting = [name for name, each in _FORMATS.items() if each.fits(path)]
        if len(fitting) != 1:
            signs = "; ".join(f"{name}: {each.sign}" for name, each in _FORMATS.items())
            raise ValueError(
                f"{path}: looks like {fitting or 'no known format'}, expected one ({signs})"
            )
        format = fitting[0]
    if format not in _FORMATS:
        raise ValueError(f"format = {format!r}, expected one of {list(FORMATS)}")
    opener = _FORMATS[format].open
    known = [name for name in list(inspect.signature(opener).parameters)[1:] if name != "poses"]
    for name in options:
        if name not in known:
            raise ValueError(
                f"{name} is not an option of format {format!r}, expected one of {known}"
            )
    return opener(path, poses=poses, **options)
