"""Scores of a map on frames that it was not given: for real streams, which have no ground truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.scoring.metrics import held_out_surface

_FIRST = 15  # the map has to have seen something before
_EVERY = 10
_POINTS = 20_000  # over all held-out frames


def held_out_frames(count: int) -> range:
    """Chooses the frames that a map is scored on and not given.

    Args:
        count: Number of frames in the stream.

    Returns:
        Their indices: every tenth, from the 16th on.

    Example:
        held_out = scoring.held_out_frames(len(stream))
        mapped = [index for index in range(len(stream)) if index not in held_out]
    """
    return range(count)[_FIRST::_EVERY]


def draw_returns(
    cloud: np.ndarray,
    pose: np.ndarray,
    config: Config,
    frames: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draws returns of a held-out frame, within the range of the map.

    Args:
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.
        config: The map's configuration, which limits the range.
        frames: Number of frames that are held out in all.
        rng: Source of randomness.

    Returns:
        (n, 3) m, world frame; 20,000 over all frames.

    Example:
        rng = np.random.default_rng(0)
        returns_world = scoring.draw_returns(cloud, pose, config, frames=10, rng=rng)
    """
    ranges = np.linalg.norm(cloud, axis=-1)  # NaN for no return, and no comparison is True then
    cloud = cloud[(ranges >= config.min_range) & (ranges <= config.max_range)]
    quota = max(_POINTS // frames, 1)
    cloud = rng.choice(cloud, min(quota, len(cloud)), replace=False)
    return cloud @ pose[:3, :3].T + pose[:3, 3]


def score_held_out(
    sdf: Callable[[np.ndarray], Any],
    observed: Callable[[np.ndarray], Any],
    points_world: np.ndarray,
) -> dict[str, float]:
    """Scores a map on held-out returns, where the map has observed the place.

    Args:
        sdf: Maps (n, 3) float32 points, m, world frame, to (n,) distances, m.
        observed: Maps (n, 3) float32 points to (n,) bool; False outside the bounds.
        points_world: (N, 3) m, from `draw_returns`.

    Returns:
        `points`: N.
        `points_observed`: how many of them the map has observed.
        The scores of `held_out_surface` at these, if there are any.

    Example:
        scores = scoring.score_held_out(
            lambda points: hio.sdf(field, points),
            lambda points: hio.query(field, points).observed,
            returns_world,
        )
    """
    if not len(points_world):
        return {"points": 0, "points_observed": 0}
    seen = points_world[np.asarray(observed(points_world))]
    counts: dict[str, float] = {"points": len(points_world), "points_observed": len(seen)}
    return counts | (held_out_surface(sdf, seen) if len(seen) else {})
