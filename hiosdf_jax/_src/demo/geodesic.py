"""The cheapest paths over the floor of a map that is only partly observed.

Unobserved space costs little more than free space, since what leads into it may lead to the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from hiosdf_jax._src.demo.robot import Robot, body
from hiosdf_jax._src.field.queries import AnyField, query

PathFrom = Callable[[np.ndarray], np.ndarray]
"""(2,) m -> (P, 2) m, the cheapest path from a point to the goal."""

# Cost of crossing a cell, relative to one that is observed and free.
_UNSEEN = 1.5
_NEAR = 3.0
_BLOCKED = 100.0
_AHEAD_M = 0.6  # distance of the place on the path toward which a robot heads
_REACH_INTO_UNSEEN = 0.3  # m beyond observed space in which surfaces still count


class Floor(NamedTuple):
    """Level cells that the geodesic runs over.

    Attributes:
        corner: Center of cell (0, 0), (2,) m.
        spacing: m.
        shape: Number of cells along x and y.
    """

    corner: np.ndarray
    spacing: float
    shape: tuple[int, int]

    def cell(self, xy: np.ndarray) -> tuple[int, int]:
        """Returns the cell that contains a point, or the nearest cell."""
        index = np.rint((np.asarray(xy, float) - self.corner) / self.spacing).astype(int)
        i, j = np.clip(index, 0, np.array(self.shape) - 1).tolist()
        return i, j

    def centers(self) -> np.ndarray:
        """Returns the centers of the cells, (X, Y, 2) m."""
        return self.corner + self.spacing * np.indices(self.shape).transpose(1, 2, 0)


class Survey(NamedTuple):
    """What a map knows of the cells of a floor.

    Attributes:
        gap: Clearance of the body to surfaces, m, (X, Y); inf where none is near observed space.
        seen: Whether the whole body would be in observed space, (X, Y) bool.
    """

    gap: np.ndarray
    seen: np.ndarray


def lay_floor(bounds: Any, spacing: float) -> Floor:
    """Covers the x and y of a box with cells.

    Args:
        bounds: ((x0, y0, z0), (x1, y1, z1)) m.
        spacing: Edge of a cell, m.

    Returns:
        The floor.
    """
    low, high = np.asarray(bounds, float)[:, :2]
    x, y = np.ceil((high - low) / spacing - 1e-6).astype(int).tolist()
    return Floor(low + spacing / 2, spacing, (x, y))


def survey(robot: Robot, field: AnyField, floor: Floor) -> Survey:
    """Queries the map for a robot's body in each cell.

    Args:
        robot: The robot.
        field: The map.
        floor: The cells.

    Returns:
        What the map knows of each cell.
    """
    points = body(robot, floor.centers().astype(np.float32))
    distance, frontier = (np.asarray(a) for a in _distance_and_frontier(field, points))
    # Behind observed space the sign is a guess, but the surface is real.
    unsigned = np.where(frontier > 0, distance, np.abs(distance))
    known = frontier > -_REACH_INTO_UNSEEN
    return Survey(
        gap=np.where(known, unsigned, np.inf).min(axis=-1) - robot.radius,
        seen=(frontier > robot.radius + robot.margin).all(axis=-1),
    )


def cell_costs(robot: Robot, cells: Survey, barred: np.ndarray | None = None) -> np.ndarray:
    """Computes the cost of crossing each cell, relative to a free one.

    Cells where the body would touch an observed surface cost so much that the geodesic avoids them.
    Cells that are not observed over the body's height cost little more than free ones.

    Args:
        robot: The robot.
        cells: What the map knows of them.
        barred: (X, Y) bool, cells to avoid whatever the map says.

    Returns:
        (X, Y) float64.
    """
    costs = np.where(cells.seen, 1.0, _UNSEEN)
    costs += _NEAR * np.clip(1 - cells.gap / robot.comfort, 0, 1)
    blocked = cells.gap < robot.margin
    if barred is not None:
        blocked |= barred
    return np.where(blocked, _BLOCKED, costs)


def cost_to_go(costs: np.ndarray, floor: Floor, goal: np.ndarray) -> tuple[np.ndarray, PathFrom]:
    """Finds the cheapest paths from all cells to a goal.

    Args:
        costs: (X, Y), see `cell_costs`.
        floor: The cells.
        goal: (2,) m.

    Returns:
        to_go: (X, Y), cost of the path as a length in free cells, m.
        path_from: (2,) m -> (P, 2) m, the path from a point to the goal.
    """
    from skimage.graph import MCP_Geometric

    search = MCP_Geometric(costs * floor.spacing)
    to_go, _ = search.find_costs([floor.cell(goal)])

    def path_from(xy: np.ndarray) -> np.ndarray:
        cells = np.array(search.traceback(floor.cell(xy)))[::-1]
        return floor.corner + floor.spacing * cells

    return to_go, path_from


def heading_along(path: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Returns the direction from a point to a place a little ahead on a path.

    Args:
        path: (P, 2) m.
        xy: (2,) m.

    Returns:
        (2,) unit vector, or zero at the path's end.
    """
    offsets = path - xy
    lengths = np.linalg.norm(offsets, axis=1)
    start = int(np.argmin(lengths))
    beyond = np.nonzero(lengths[start:] >= _AHEAD_M)[0]
    target = start + int(beyond[0]) if len(beyond) else len(path) - 1
    return offsets[target] / max(lengths[target], 1e-6)


@jax.jit
def _distance_and_frontier(field: AnyField, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    answer = query(field, points)
    return answer.sdf, answer.frontier
