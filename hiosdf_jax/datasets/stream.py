"""What a dataset is to the rest of the code: a length, and items of (cloud, pose)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

_POINTS_PER_FRAME = 5000  # drawn from each cloud
# A return counts where it is not alone: mirrors, glass and dust make lone ones, far out.
# Percentiles alone would cut off a room that was only glanced at through a door, counts alone the
# far walls of a short stream, so that either may vouch for a return.
_CELL = 0.5  # m
_MIN_POINTS_PER_CELL = 10
_PERCENTILES = (0.1, 99.9)
_RIGID_TOLERANCE = 0.01  # on R^T R - I; recorded poses are rounded


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
        """
        ...


class Extent(NamedTuple):
    """What one pass over a stream tells about it.

    Attributes:
        bounds: ((x0, y0, z0), (x1, y1, z1)) metres, world; the form that `Config` takes.
        max_range: metres; nearly every return (99.9 %) is nearer to the sensor than this.
    """

    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    max_range: float


def find_bounds(stream: Stream, margin: float = 0.3) -> Extent:
    """Finds the box that a stream sees, in one pass over it with a progress bar.

    Stray returns do not blow the box up: on each side the outermost returns, up to 0.1 % of all,
    are left out unless they have company (10 sampled returns in half a metre). The path of the
    sensor is always inside.

    Args:
        stream: The frames. Those without a return or with a pose that is not rigid are passed over.
        margin: Metres added on every side.

    Returns:
        The bounds, in the world, and the range of the sensor.

    Raises:
        ValueError: Margin is negative, or no frame has both a return and a rigid pose.
    """
    from tqdm import tqdm

    if not margin >= 0:
        raise ValueError(f"margin = {margin} m, expected >= 0")
    rng = np.random.default_rng(0)
    points, ranges, path = [], [], []
    for i in tqdm(range(len(stream)), desc="finding bounds", unit="frame"):
        cloud, pose = stream[i]
        cloud = cloud[np.isfinite(cloud).all(axis=-1)]
        if not len(cloud) or not _is_rigid(pose):
            continue
        cloud = rng.choice(cloud, min(_POINTS_PER_FRAME, len(cloud)), replace=False)
        points.append(cloud @ pose[:3, :3].T + pose[:3, 3])
        ranges.append(np.linalg.norm(cloud, axis=-1))
        path.append(pose[:3, 3])
    if not points:
        raise ValueError(f"none of the {len(stream)} frames has a return and a rigid pose")
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


def _is_rigid(pose: np.ndarray) -> bool:
    if not np.isfinite(pose).all():
        return False
    rotation = pose[:3, :3].astype(float)
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    return bool(error < _RIGID_TOLERANCE and np.linalg.det(rotation) > 0)


def _has_company(points: np.ndarray) -> np.ndarray:
    """Tells for each of (N, 3) points whether its cell holds enough of them; (N,) bool."""
    key = np.zeros(len(points), np.int64)
    for coordinate in np.floor(points / _CELL).T:
        # Ranks of the cells in use, not their indices: a return 1e9 m away cannot overflow the key.
        cells, rank = np.unique(coordinate, return_inverse=True)
        key = key * len(cells) + rank
    _, cell_of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    return count[cell_of_point] >= _MIN_POINTS_PER_CELL
