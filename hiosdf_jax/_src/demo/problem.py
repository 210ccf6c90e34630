"""Start and goal of an exploration: in two rooms, out of sight of each other, with a path between.

This module knows the exact apartment; the robot does not.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hiosdf_jax._src.demo.geodesic import Floor
from hiosdf_jax._src.demo.primitives import signed_distance
from hiosdf_jax._src.demo.robot import Robot

_ROOMS = {  # inner faces, ((x0, y0), (x1, y1)) m
    "living room": ((0.0, 0.0), (5.6, 4.4)),
    "kitchen": ((5.7, 0.0), (10.0, 4.4)),
    "hall": ((7.5, 4.5), (10.0, 8.0)),
    "bedroom": ((3.3, 4.5), (7.4, 8.0)),
    "study": ((0.0, 4.5), (3.2, 8.0)),
}
_ROOM_TO_PASS = 0.1  # m, least clearance along the path that must exist
_ROOM_TO_START = 0.15  # m more around start and goal


class Problem(NamedTuple):
    """Where a robot starts and where it has to go.

    Attributes:
        start: (3,) x, y (m), yaw (rad).
        goal: (2,) x, y (m).
        rooms: Names of the rooms of both.
    """

    start: np.ndarray
    goal: np.ndarray
    rooms: tuple[str, str]


def draw_problem(model: Any, robot: Robot, floor: Floor, eye_height: float, seed: int) -> Problem:
    """Draws a start and a goal in another room, out of sight and with a path between them.

    Args:
        model: The apartment.
        robot: The robot.
        floor: The cells to draw from.
        eye_height: Height of the line of sight, m.
        seed: Seed of the draw.

    Returns:
        The problem.
    """
    from scipy.ndimage import distance_transform_edt, label

    rng = np.random.default_rng(seed)
    centers = floor.centers()
    gap = exact_clearance(model, robot, centers.reshape(-1, 2), samples=len(robot.heights))
    passable = gap.reshape(floor.shape) > _ROOM_TO_PASS
    regions: Any = label(passable)[0]  # pyright: ignore[reportIndexIssue]
    roomy = floor.spacing * np.asarray(distance_transform_edt(passable)) > _ROOM_TO_START
    names = list(_ROOMS)
    while True:
        first, second = rng.choice(len(names), 2, replace=False).tolist()
        start = _draw_cell(roomy, centers, _ROOMS[names[first]], rng)
        goal = _draw_cell(roomy, centers, _ROOMS[names[second]], rng)
        xy, goal_xy = centers[start], centers[goal]
        if regions[start] == regions[goal] and not _in_sight(model, xy, goal_xy, eye_height):
            yaw = rng.uniform(-np.pi, np.pi)
            return Problem(np.array([*xy, yaw]), goal_xy, (names[first], names[second]))


def exact_clearance(model: Any, robot: Robot, xy: np.ndarray, samples: int = 16) -> np.ndarray:
    """Computes the exact clearance of a robot's body in the apartment.

    Args:
        model: The apartment.
        robot: The robot.
        xy: (N, 2) m, where the robot is.
        samples: Number of spheres along the axis of the capsule that the body's spheres span.

    Returns:
        (N,) m; negative in collision.
    """
    heights = np.linspace(robot.heights[0], robot.heights[-1], samples)
    points = np.concatenate(
        [np.repeat(xy, len(heights), axis=0), np.tile(heights, len(xy))[:, None]], axis=1
    )
    return signed_distance(model, points)[0].reshape(len(xy), -1).min(axis=1) - robot.radius


def _draw_cell(
    roomy: np.ndarray, centers: np.ndarray, room: Any, rng: np.random.Generator
) -> tuple[int, int]:
    inside = ((centers >= room[0]) & (centers <= room[1])).all(axis=-1)
    cells = np.argwhere(roomy & inside)
    i, j = cells[rng.integers(len(cells))].tolist()
    return i, j


def _in_sight(model: Any, start: np.ndarray, goal: np.ndarray, eye_height: float) -> bool:
    """Whether the straight line between two points is free at a height."""
    along = np.linspace(0, 1, 200)[:, None]
    points = np.column_stack([start + along * (goal - start), np.full(200, eye_height)])
    return bool((signed_distance(model, points)[0] > 0).all())
