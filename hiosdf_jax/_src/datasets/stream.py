"""The protocol that every dataset reader implements: a length, and items (cloud, pose)."""

from __future__ import annotations

import numbers
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from hiosdf_jax._src.numerics.intake import as_number, check_pose, cloud_and_returns
from hiosdf_jax._src.numerics.rigid import FARTHEST_M

_POINTS_PER_FRAME = 5000  # drawn from each cloud
# Mirrors, glass and dust make single returns far outside. Percentiles alone would cut off a room
# that was only glanced at through a door, and counts alone the far walls of a short stream.
# A return therefore counts if either test accepts it.
_CELL = 0.5  # m
_MIN_POINTS_PER_CELL = 10
_PERCENTILES = (0.1, 99.9)
# A frame is stray if both neighbors are farther away than these many meters and usual steps.
_JUMP_M, _JUMP_STEPS = 100.0, 100.0
_LEAST_PATH = 4  # frames that show what is usual


class Stream(Protocol):
    """A sequence of posed clouds, converted one frame at a time.

    Any class with these two methods is a stream:

        class Recording:
            def __len__(self):
                return len(self.files)

            def __getitem__(self, index):
                return np.load(self.files[index]), self.poses[index]

    A stream may also have an attribute `stamps`: (F,) s, the times of its frames. A trajectory that
    `hiosdf map` writes has these times.
    """

    def __len__(self) -> int:
        """The number of frames."""
        ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """One frame.

        Args:
            index: 0 <= index < len(self).

        Returns:
            cloud: (N, 3) float32, m, sensor frame; a row with a NaN or inf is not a return.
            pose: (4, 4) float32, T_world_sensor.

        Raises:
            IndexError: Index is out of range.
            ValueError: The frame cannot be read; the message names the file, and the line if
                there is one.
        """
        ...


class BadFrameError(ValueError):
    """A frame of a stream cannot be used; the message names the frame and the reason."""


class NoPosesError(ValueError):
    """A recording has no poses. With `poses=False`, `open_stream` opens it nevertheless."""


def check_has_poses(path: Path, name: str) -> None:
    """Raises a NoPosesError, which calls it `name`, if a recording's file of poses is missing."""
    if not path.exists():
        raise NoPosesError(f"{path.parent}: has no poses, expected them in {name}")


class FrameStream:
    """A `Stream` that reads each frame on demand.

    Attributes:
        path: Where the frames are.
        stamps: (F,) float64 s, the times of the frames, or None if they are not known.

    Example:
        first_frames = FrameStream("drive", 20, stream.__getitem__)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        count: int,
        read: Callable[[int], tuple[np.ndarray, np.ndarray]],
        stamps: npt.ArrayLike | None = None,
    ) -> None:
        """Makes a stream from a function.

        Args:
            path: Where the frames are, for messages.
            count: Number of frames.
            read: Maps 0 <= index < count to a cloud (N, 3) and a pose (4, 4), as in `Stream` but
                of any float type.
            stamps: (count,) s, the times of the frames, NaN where they are not known.

        Raises:
            ValueError: There are more stamps than frames, or fewer.
        """
        self.path = path
        self.stamps = None if stamps is None else np.asarray(stamps, float)
        if self.stamps is not None and self.stamps.shape != (count,):
            raise ValueError(
                f"{path}: stamps has shape {self.stamps.shape}, expected ({count},), one per frame"
            )
        self._count, self._read = count, read

    def __len__(self) -> int:
        """The number of frames."""
        return self._count

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """One frame.

        Args:
            index: -len(self) <= index < len(self).

        Returns:
            cloud: (N, 3) float32, m, sensor frame; a row with a NaN or inf is not a return.
            pose: (4, 4) float32, T_world_sensor.

        Raises:
            IndexError: Index is out of range.
            ValueError: The frame cannot be read; the message names the file, and the line if
                there is one.
        """
        index = frame_index(index, self._count, self.path)
        try:
            cloud, pose = self._read(index)
        except OSError as error:  # the file of this frame: the frame is bad, not the stream
            raise ValueError(f"{error.filename}: {error.strerror}") from error
        return cloud.astype(np.float32, copy=False), pose.astype(np.float32)


def frame_index(index: int, count: int, path: str | os.PathLike[str]) -> int:
    """Resolves the index of a frame as Python sequences do.

    Args:
        index: From the start, or negative from the end.
        count: Number of frames.
        path: Where the frames are, for the message.

    Returns:
        0 <= index < count.

    Raises:
        IndexError: Index is out of range. It also ends a plain `for cloud, pose in stream`.
        TypeError: It is not a whole number, for example a slice.
    """
    if not isinstance(index, numbers.Integral):
        raise TypeError(f"{path}: frame {index!r}, expected a whole number")
    if not -count <= index < count:
        raise IndexError(f"{path}: frame {index}, expected one of {count} frames")
    return index % count


def read_frame(stream: Stream, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads a frame and checks that a map can use it.

    Args:
        stream: The frames.
        index: 0 <= index < len(stream).

    Returns:
        The cloud and the pose, as from `Stream`. The cloud has a return and the pose is rigid.

    Raises:
        BadFrameError: The frame cannot be read, has no return, or has a pose that is not rigid.

    Example:
        for index in range(len(stream)):
            try:
                state = hio.update(state, *datasets.read_frame(stream, index))
            except datasets.BadFrameError as error:
                print(error)
    """
    try:
        cloud, pose = stream[index]
        check_pose(pose)
        cloud_and_returns(cloud)
    except ValueError as error:
        raise BadFrameError(f"frame {index}: {' '.join(str(error).split())}") from error
    return cloud, pose


class Extent(NamedTuple):
    """The box that a stream covers and the range of its sensor.

    Attributes:
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame, as `Config` takes it.
        max_range: m; 99.9 % of the returns are closer to the sensor than this.
    """

    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    max_range: float


def find_bounds(stream: Stream, margin: float = 0.3, *, skip_bad_frames: bool = False) -> Extent:
    """Finds the box that a stream covers, in one reading with a progress bar.

    Stray returns do not enlarge the box: on each side the outermost returns, up to 0.1 % of all,
    are left out unless 10 sampled returns share their cell of 0.5 m. The path of the sensor is
    always inside, but for frames 100 m and 100 usual steps away from the frames before and after
    them: their poses are wrong, and a warning names them.

    Args:
        stream: The frames.
        margin: m, added on every side.
        skip_bad_frames: Skip frames that cannot be read, have no return, or have a pose that is
            not rigid.

    Returns:
        The bounds, in the world frame, and the range of the sensor.

    Raises:
        BadFrameError: A frame is bad and `skip_bad_frames` is False.
        ValueError: Margin is not a number, or is negative; or no frame is usable.

    Example:
        extent = datasets.find_bounds(stream)
        config = hio.Config.light(extent.bounds, max_range=extent.max_range)
    """
    from tqdm import tqdm

    margin = as_number("margin", margin, 0)
    rng = np.random.default_rng(0)
    frames, points, ranges, path = [], [], [], []
    for i in tqdm(range(len(stream)), desc="finding bounds", unit="frame"):
        try:
            cloud, pose = read_frame(stream, i)
            cloud = cloud[(np.abs(cloud) <= FARTHEST_M).all(axis=-1)]  # False for NaN
            if not len(cloud):
                raise BadFrameError(
                    f"frame {i}: none of its returns is nearer than {FARTHEST_M / 1000:g} km; is "
                    "the unit m?"
                )
        except BadFrameError:
            if not skip_bad_frames:
                raise
            continue
        frames.append(i)
        cloud = rng.choice(cloud, min(_POINTS_PER_FRAME, len(cloud)), replace=False)
        points.append(cloud @ pose[:3, :3].T + pose[:3, 3])
        ranges.append(np.linalg.norm(cloud, axis=-1))
        path.append(pose[:3, 3])
    if not points:
        raise ValueError(f"none of the {len(stream)} frames can be used, expected at least one")
    stray = _is_stray(np.array(path))
    for k in np.flatnonzero(stray):
        warnings.warn(
            f"frame {frames[k]} at {path[k].tolist()} m is far from the frames before and after "
            "it: is its pose wrong? The bounds leave it out",
            stacklevel=2,
        )
    points, ranges, path = (
        [part for part, far in zip(parts, stray, strict=True) if not far]
        for parts in (points, ranges, path)
    )
    points = np.concatenate(points)
    corners = np.concatenate(
        [np.percentile(points, _PERCENTILES, axis=0), points[_in_crowded_cells(points)], path]
    )
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    (x0, y0, z0), (x1, y1, z1) = lower.tolist(), upper.tolist()
    return Extent(
        bounds=((x0, y0, z0), (x1, y1, z1)),
        max_range=float(np.percentile(np.concatenate(ranges), _PERCENTILES[1])),
    )


def _is_stray(path: np.ndarray) -> np.ndarray:
    """Returns a mask, (F,) bool, of the positions (F, 3) m that the sensor cannot have reached."""
    if len(path) < _LEAST_PATH:
        return np.zeros(len(path), bool)
    steps = np.linalg.norm(np.diff(path.astype(float), axis=0), axis=-1)
    nearest = np.minimum(np.append(steps, np.inf), np.append(np.inf, steps))
    return nearest > max(_JUMP_STEPS * np.median(steps), _JUMP_M)


def _in_crowded_cells(points: np.ndarray) -> np.ndarray:
    """Returns a mask, (N,) bool, of the (N, 3) points whose cell holds enough of them."""
    key = np.zeros(len(points), np.int64)
    for coordinate in np.floor(points / _CELL).T:
        # Ranks of the occupied cells instead of their indices: a return 1e9 m away cannot
        # overflow the key.
        cells, rank = np.unique(coordinate, return_inverse=True)
        key = key * len(cells) + rank
    _, cell_of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    return count[cell_of_point] >= _MIN_POINTS_PER_CELL
