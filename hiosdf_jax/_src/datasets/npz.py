"""Streams in one `.npz` file: a depth camera, a LiDAR's range images, or clouds one after another.

Every file has `poses` (F, 4, 4), T_world_sensor in m, unless they are not read, and one of

- `depth` (F, H, W), `K` (3, 3), `depth_scale`: m = depth / depth_scale along the optical axis;
  0 is not a return, as are the values listed in the optional `invalid`;
- `range` (F, ...), `directions` (..., 3) unit vectors, `range_scale`: m = range / range_scale;
  0 is not a return;
- `points_mm` (P, 3) mm, sensor frame, `offsets` (F + 1,): frame i has the rows offsets[i] to
  offsets[i + 1].

The optional `stamp` (F,) has the times of the frames, s. The optional `eval_*` arrays are exact
distances, see `read_truth`.
"""

from __future__ import annotations

import math
import os
from functools import partial

import jax
import numpy as np

from hiosdf_jax._src.datasets import sensors
from hiosdf_jax._src.datasets.archive import Archive
from hiosdf_jax._src.datasets.files import most_returns
from hiosdf_jax._src.datasets.stream import NoPosesError, frame_index
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.numerics.intake import check_pose

_depth_to_cloud = jax.jit(sensors.depth_to_cloud)
_ranges_to_cloud = jax.jit(sensors.ranges_to_cloud)

_LENGTH_TOLERANCE = 0.01  # of directions, which may be stored as float16

_Shape = tuple[int | str, ...]  # a letter stands for any length

_LAYOUTS = {  # the key that identifies a layout: the other keys that it needs
    "depth": ("K", "depth_scale"),
    "range": ("directions", "range_scale"),
    "points_mm": ("offsets",),
}


class NpzStream:
    """A `Stream` over one `.npz` file, converted one frame at a time.

    The raw arrays are held in memory as they are in the file, since compressed npz files cannot be
    memory-mapped. Each item is converted to float32 m.

    Attributes:
        path: The file.
        stamps: (F,) float64 s, the times of the frames, or None if the file has none.
    """

    def __init__(self, path: str | os.PathLike[str], *, poses: bool = True) -> None:
        """Loads and checks a file.

        Only the count and the shape of the poses are checked here: a pose that is not rigid makes
        a bad frame, not a bad file.

        Args:
            path: The `.npz` file.
            poses: Whether to read the poses. If not, each pose is the identity.

        Raises:
            FileNotFoundError: There is no such file.
            NoPosesError: The file has no poses.
            ValueError: The file is not an npz file, or another key is missing, misshapen or out of
                range; the message names the file, the key, what was found and what was expected.
        """
        self.path = path
        with Archive(path) as archive:
            layouts = [key for key in _LAYOUTS if key in archive.names]
            if len(layouts) != 1:
                raise ValueError(
                    f"{path}: has {layouts or 'none'} of the keys {list(_LAYOUTS)}, expected one"
                )
            self._layout = layouts[0]
            if poses and "poses" not in archive.names:
                raise NoPosesError(f"{path}: has no poses, expected the key 'poses'")
            keys = (*(["poses"] if poses else []), self._layout, *_LAYOUTS[self._layout])
            missing = [key for key in keys if key not in archive.names]
            if missing:
                raise ValueError(
                    f"{path}: key {missing[0]!r} is missing, expected {list(keys)} in a file with "
                    f"{self._layout!r}"
                )
            if self._layout == "depth" and "invalid" in archive.names:
                keys = (*keys, "invalid")
            if "stamp" in archive.names:
                keys = (*keys, "stamp")
            self._arrays = {key: _array(archive, key) for key in keys}
        check = {"depth": self._check_depth, "range": self._check_range}
        self._count = check.get(self._layout, self._check_points)()
        if poses:
            self._expect("poses", (self._count, 4, 4))
        self.stamps = None
        if "stamp" in self._arrays:
            self._expect("stamp", (self._count,))
            self.stamps = self._arrays["stamp"].astype(float)

    def __len__(self) -> int:
        """The number of frames."""
        return self._count

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """One frame.

        Args:
            index: -len(self) <= index < len(self).

        Returns:
            cloud: (N, 3) float32, m, sensor frame; NaN for pixels or rays without return.
            pose: (4, 4) float32, T_world_sensor, as it is in the file.

        Raises:
            IndexError: Index is out of range.
            ValueError: The pose is not finite or not rigid.
        """
        index = frame_index(index, len(self), self.path)
        pose = np.eye(4, dtype=np.float32)
        if "poses" in self._arrays:
            pose = check_pose(self._arrays["poses"][index], f"{self.path}: poses[{index}]")
        if self._layout == "points_mm":
            offsets = self._arrays["offsets"]
            rows = self._arrays["points_mm"][offsets[index] : offsets[index + 1]]
            cloud = rows.astype(np.float32) / np.float32(1000)
            return cloud, pose
        raw = self._arrays[self._layout][index]
        lengths = raw.astype(np.float32) / self._scale
        lengths[np.isin(raw, self._arrays.get("invalid", ()))] = np.nan
        return np.asarray(self._to_cloud(lengths)), pose

    def _check_depth(self) -> int:
        depth, matrix = self._arrays["depth"], self._arrays["K"]
        self._expect("depth", ("F", "H", "W"))
        self._expect("K", (3, 3))
        sensors.check_camera(f"{self.path}: K", matrix)
        self._scale = self._positive("depth_scale")
        self._to_cloud = partial(_depth_to_cloud, intrinsics=matrix.astype(np.float32))
        self._check_size(math.prod(depth.shape[1:]))
        return len(depth)

    def _check_range(self) -> int:
        ranges = self._arrays["range"]
        if ranges.ndim < 2:
            raise ValueError(f"{self.path}: range has shape {ranges.shape}, expected (F, ...)")
        self._expect("directions", (*ranges.shape[1:], 3))
        self._scale = self._positive("range_scale")
        directions = self._arrays["directions"].astype(np.float32)
        lengths = np.linalg.norm(directions.reshape(-1, 3), axis=1)
        wrong = lengths[np.abs(lengths - 1) > _LENGTH_TOLERANCE]  # without those that are NaN
        if len(wrong) or not np.isfinite(lengths).any():
            found = f"length {wrong[0]:.4g}" if len(wrong) else "no finite length"
            raise ValueError(f"{self.path}: directions have {found}, expected unit vectors")
        self._to_cloud = partial(_ranges_to_cloud, directions=directions)
        self._check_size(math.prod(ranges.shape[1:]))
        return len(ranges)

    def _check_size(self, returns: int) -> None:
        """Raises if a frame has this many returns, which are too many."""
        most = most_returns(os.stat(self.path).st_size)
        if returns > most:
            raise ValueError(
                f"{self.path}: {self._layout} has {returns} returns in a frame, expected at most "
                f"{most}"
            )

    def _check_points(self) -> int:
        points, offsets = self._arrays["points_mm"], self._arrays["offsets"]
        self._expect("points_mm", ("P", 3))
        if offsets.ndim != 1 or len(offsets) < 1 or offsets.dtype.kind not in "iu":
            raise ValueError(
                f"{self.path}: offsets has shape {offsets.shape} and type {offsets.dtype}, "
                f"expected (F + 1,) integers"
            )
        edges = offsets.astype(np.int64)
        if edges[0] != 0 or edges[-1] != len(points):
            raise ValueError(
                f"{self.path}: offsets run from {edges[0]} to {edges[-1]}, "
                f"expected 0 to the {len(points)} rows of points_mm"
            )
        falling = np.flatnonzero(np.diff(edges) < 0)
        if len(falling):
            i = falling[0]
            raise ValueError(
                f"{self.path}: offsets of frame {i} run from {edges[i]} to {edges[i + 1]}, "
                f"expected offsets that never decrease"
            )
        self._check_size(int(np.diff(edges).max(initial=0)))
        return len(offsets) - 1

    def _expect(self, key: str, shape: _Shape) -> None:
        _expect(self._arrays[key], key, shape, self.path)

    def _positive(self, key: str) -> np.float32:
        self._expect(key, ())
        value = np.float32(self._arrays[key])
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{self.path}: {key} = {value}, expected a number > 0")
        return value


def read_truth(path: str | os.PathLike[str]) -> GroundTruth | None:
    """Reads the exact distances of a file.

    Args:
        path: The `.npz` file, with all of `eval_visible` (N, 3), `eval_visible_sdf` (N,),
            `eval_visible_grad` (N, 3), `eval_visible_frame` (N,), `eval_surface` (M, 3) or none
            of them.

    Returns:
        The exact distances, or None if the file has none of these keys.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not an npz file, or some of the keys are missing or misshapen.

    Example:
        truth = datasets.read_truth("house_depth.npz")
        print(truth.points_world.shape, truth.sdf.shape)
    """
    keys = ("visible", "visible_sdf", "visible_grad", "visible_frame", "surface")
    keys = tuple(f"eval_{key}" for key in keys)
    with Archive(path) as archive:
        missing = [key for key in keys if key not in archive.names]
        if len(missing) == len(keys):
            return None
        if missing:
            raise ValueError(f"{path}: key {missing[0]!r} is missing, expected {list(keys)}")
        values = [_array(archive, key) for key in keys]
    count = len(values[0]) if values[0].ndim else 0
    shapes = ((count, 3), (count,), (count, 3), (count,), ("M", 3))
    for key, value, shape in zip(keys, values, shapes, strict=True):
        _expect(value, key, shape, path)
    points, sdf, grad, frame, surface = values
    return GroundTruth(
        points_world=points.astype(np.float32),
        sdf=sdf.astype(np.float32),
        grad=grad.astype(np.float32),
        frame=frame.astype(np.int32),
        surface_points_world=surface.astype(np.float32),
    )


def _array(archive: Archive, key: str) -> np.ndarray:
    kind = archive.describe(key).dtype
    if kind.kind not in "fiu":
        raise ValueError(f"{archive.path}: {key} has type {kind}, expected numbers")
    return archive.read(key)


def _expect(array: np.ndarray, key: str, shape: _Shape, path: str | os.PathLike[str]) -> None:
    """Raises unless the array has the shape, where a letter stands for any length."""
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{path}: {key} has shape {array.shape}, expected {expected}")
