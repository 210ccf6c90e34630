"""What a dataset is to the rest of the code: a length, and items of (cloud, pose)."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from hiosdf_jax._src.datasets.poses import check_pose

_POINTS_PER_FRAME = 5000  # drawn from each cloud
# A return counts where it is not alone: mirrors, glass and dust make lone ones, far out.
# Percentiles alone would cut off a room that was only glanced at through a door, counts alone the
# far walls of a short stream, so that either may vouch for a return.
_CELL = 0.5  # m
_MIN_POINTS_PER_CELL = 10
_PERCENTILES = (0.1, 99.9)


class Stream(Protocol):
    """A posed sequence of clouds, converted one frame at a time."""

    def __len__(self) -> int:
        """The number of frames."""
        ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """One frame.

        Args:
            index: 0 <= index < len(self).

        Returns:
            cloud: (N, 3) float32, metres, sensor frame; a non-finite row is no return.
            pose: (4, 4) float32, T_world_sensor.

        Raises:
            IndexError: Index is out of range.
            ValueError: The frame cannot be read; the message names the file, and the line if
                there is one.
        """
        ...


class BadFrameError(ValueError):
    """A frame of a stream cannot be used; the message names it and tells why."""


class FrameStream:
    """A `Stream` that reads each frame when it is asked for."""

    def __init__(
        self,
        path: str | os.PathLike[str],
        count: int,
        read: Callable[[int], tuple[np.ndarray, np.ndarray]],
    ) -> None:
        """Makes a stream of a function.

        Args:
            path: Where the frames are, for messages.
            count: How many frames there are.
            read: Takes 0 <= index < count to a cloud (N, 3) and a pose (4, 4), as `Stream` does,
                of any float type.
        """
        self.path = path
        self._count, self._read = count, read

    def __len__(self) -> int:
        """The number of frames."""
        return self._count

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """One frame.

        Args:
            index: -len(self) <= index < len(self).

        Returns:
            cloud: (N, 3) float32, metres, sensor frame; a non-finite row is no return.
            pose: (4, 4) float32, T_world_sensor.

        Raises:
            IndexError: Index is out of range.
            ValueError: The frame cannot be read; the message names the file, and the line if
                there is one.
        """
        index = frame_index(index, self._count, self.path)
        try:
            cloud, pose = self._read(index)
        except OSError as error:  # a frame's own file: that frame is bad, not the stream
            raise ValueError(f"{error.filename}: {error.strerror}") from error
        return cloud.astype(np.float32, copy=False), pose.astype(np.float32)


def frame_index(index: int, count: int, path: str | os.PathLike[str]) -> int:
    """Resolves the index of a frame as a sequence does.

    Args:
        index: From the start, or negative from the end.
        count: How many frames there are.
        path: Where the frames are, for the message.

    Returns:
        0 <= index < count.

    Raises:
        IndexError: Index is out of range; also what ends a plain `for cloud, pose in stream`.
    """
    if not -count <= index < count:
        raise IndexError(f"{path}: frame {index}, expected one of {count} frames")
    return index % count


def read_frame(stream: Stream, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads a frame that a map can use.

    Args:
        stream: The frames.
        index: 0 <= index < len(stream).

    Returns:
        The cloud and the pose, as of `Stream`; the cloud has a return and the pose is rigid.

    Raises:
        BadFrameError: The frame cannot be read, or it is not so.
    """
    try:
        cloud, pose = stream[index]
        check_pose(pose, f"frame {index}")
        if not np.isfinite(cloud).all(axis=-1).any():
            raise ValueError(
                f"cloud has no finite row among its {len(cloud)}, expected at least one return"
            )
    except ValueError as error:
        message = " ".join(str(error).removeprefix(f"frame {index}: ").split())
        raise BadFrameError(f"frame {index}: {message}") from error
    return cloud, pose


class Extent(NamedTuple):
    """What one pass over a stream tells about it.

    Attributes:
        bounds: ((x0, y0, z0), (x1, y1, z1)) metres, world; the form that `Config` takes.
        max_range: metres; nearly every return (99.9 %) is nearer to the sensor than this.
    """

    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    max_range: float


def find_bounds(stream: Stream, margin: float = 0.3, *, skip_bad_frames: bool = False) -> Extent:
    """Finds the box that a stream sees, in one pass over it with a progress bar.

    Stray returns do not blow the box up: on each side the outermost returns, up to 0.1 % of all,
    are left out unless they have company (10 sampled returns in half a metre). The path of the
    sensor is always inside.

    Args:
        stream: The frames.
        margin: Metres added on every side.
        skip_bad_frames: Pass over frames that cannot be read, have no return, or have a pose that
            is not rigid.

    Returns:
        The bounds, in the world, and the range of the sensor.

    Raises:
        BadFrameError: A frame is bad, and bad frames are not to be passed over.
        ValueError: Margin is negative, or no frame is usable.
    """
    from tqdm import tqdm

    if not margin >= 0:
        raise ValueError(f"margin = {margin} m, expected >= 0")
    rng = np.random.default_rng(0)
    points, ranges, path = [], [], []
    for i in tqdm(range(len(stream)), desc="finding bounds", unit="frame"):
        try:
            cloud, pose = read_frame(stream, i)
        except BadFrameError:
            if not skip_bad_frames:
                raise
            continue
        cloud = cloud[np.isfinite(cloud).all(axis=-1)]
        cloud = rng.choice(cloud, min(_POINTS_PER_FRAME, len(cloud)), replace=False)
        points.append(cloud @ pose[:3, :3].T + pose[:3, 3])
        ranges.append(np.linalg.norm(cloud, axis=-1))
        path.append(pose[:3, 3])
    if not points:
        raise ValueError(f"none of the {len(stream)} frames can be used")
    points = np.concatenate(points)
    corners = np.concatenate(
        [np.percentile(points, _PERCENTILES, axis=0), points[_has_company(points)], path]
    )
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    (x0, y0, z0), (x1, y1, z1) = lower.tolist(), upper.tolist()
    return Extent(
        bounds=((x0, y0, z0), (x1, y1, z1)),
        max_range=float(np.percentile(np.concatenate(ranges), _PERCENTILES[1])),
    )


def _has_company(points: np.ndarray) -> np.ndarray:
    """Tells for each of (N, 3) points whether its cell holds enough of them; (N,) bool."""
    key = np.zeros(len(points), np.int64)
    for coordinate in np.floor(points / _CELL).T:
        # Ranks of the cells in use, not their indices: a return 1e9 m away cannot overflow the key.
        cells, rank = np.unique(coordinate, return_inverse=True)
        key = key * len(cells) + rank
    _, cell_of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    return count[cell_of_point] >= _MIN_POINTS_PER_CELL
