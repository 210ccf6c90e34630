"""Checks clouds and poses, and pads or draws clouds to the shape of the compiled update."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from hiosdf_jax._src.numerics.posed_cloud import check_pose, finite_rows

_HASHED_EVERY = 64  # rows of a cloud per hashed row


def prepare(cloud: Any, pose: Any, capacity: int) -> tuple[np.ndarray, np.ndarray]:
    """Checks the values of a cloud and its pose, and brings the cloud to a fixed shape.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns.
        pose: (4, 4) T_world_sensor.
        capacity: Rows of the result. Smaller clouds are padded with NaN; larger ones are drawn from
            at random.

    Returns:
        The cloud (capacity, 3) and the pose, float32.

    Raises:
        ValueError: A shape is wrong, the pose is not finite or not rigid, or the cloud has no
            finite row.
    """
    cloud, pose = np.asarray(cloud, np.float32), check_pose(pose)
    finite = finite_rows(cloud)
    padded = np.empty((capacity, 3), np.float32)
    count = len(cloud)
    if count <= capacity:
        padded[:count] = cloud
    else:
        # The draw must be a function of the arguments, and differ from cloud to cloud.
        seed = zlib.crc32(cloud[::_HASHED_EVERY].tobytes(), zlib.crc32(pose.tobytes()))
        rows = _draw(finite, seed, capacity)
        count = len(rows)
        np.take(cloud, rows, axis=0, out=padded[:count], mode="clip")  # "raise" copies twice
    padded[count:] = np.nan
    return padded, pose


def _draw(finite: np.ndarray, seed: int, capacity: int) -> np.ndarray:
    """Draws the indices of at most `capacity` finite rows."""
    rows = np.flatnonzero(finite)
    dropped = len(rows) - capacity
    if dropped <= 0:
        return rows
    rng = np.random.default_rng(seed)
    # Draws with repetition until enough rows are distinct: the rows to keep or those to drop,
    # whichever are fewer. A permutation would touch every row of a large cloud.
    fewer = min(capacity, dropped)
    chosen = np.zeros(len(rows), bool)
    while missing := fewer - np.count_nonzero(chosen):
        chosen[rng.integers(len(rows), size=missing)] = True
    return rows[np.flatnonzero(chosen if fewer == capacity else ~chosen)]
