"""Exact distances at sampled points: what a map is scored against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_LEAST_RETURNS = 10  # a thin part with fewer returns is not scored
_MOST_POINTS = 50  # per part, so that a table leg counts as much as a shelf


class GroundTruth(NamedTuple):
    """Exact distances of a scene, at points of the free space that a sensor observed.

    Attributes:
        points_world: (N, 3) float32, m; points on rays, between the sensor and the surface.
        sdf: (N,) float32, m; exact distance to the nearest surface.
        grad: (N, 3) float32; exact unit gradient of the distance, d(sdf)/d(point).
        frame: (N,) int32; the frame in which the point was first sampled.
        surface_points_world: (M, 3) float32, m; exact surface points that the sensor observed.
        thin_points_world: (K, 3) float32, m; exact surface points that the sensor observed on
            parts less than 5 cm thick. Empty if the source does not mark such parts.
    """

    points_world: np.ndarray
    sdf: np.ndarray
    grad: np.ndarray
    frame: np.ndarray
    surface_points_world: np.ndarray
    thin_points_world: np.ndarray = np.empty((0, 3), np.float32)


def choose_thin(part: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Chooses the returns on thin parts that a map is scored on.

    Args:
        part: (R,) int, number of the thin part that each return lies on; -1 for other surfaces.
        rng: Source of randomness.

    Returns:
        (K,) indices of returns: up to 50 from each part that has at least 10.
    """
    order = np.argsort(part, kind="stable")
    order = order[part[order] >= 0]
    _, starts = np.unique(part[order], return_index=True)
    chosen = [
        rng.choice(rows, min(len(rows), _MOST_POINTS), replace=False)
        for rows in np.split(order, starts[1:])
        if len(rows) >= _LEAST_RETURNS
    ]
    return np.concatenate([np.empty(0, int), *chosen])
