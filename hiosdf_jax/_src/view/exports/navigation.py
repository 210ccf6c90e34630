"""A costmap for a robot that drives on a floor, as ROS's map servers read it."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import numpy as np

from hiosdf_jax._src.field.baking import bake
from hiosdf_jax._src.field.lattice import check_resolution
from hiosdf_jax._src.numerics.intake import as_number
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState

OCCUPIED, FREE, UNKNOWN = 0, 254, 128
_OCCUPIED_FROM, _FREE_BELOW = 0.65, 0.196
# A pixel p means an occupancy of (255 - p) / 255. That of 128 is unknown by the thresholds of ROS 1
# and of nav2; that of 205, which some maps have, is free by the thresholds that some files have.


@dataclasses.dataclass(frozen=True)
class Costmap:
    """Where the center of a robot may be; made by `costmap`.

    Attributes:
        cells: (Y, X) uint8: `OCCUPIED`, `FREE` or `UNKNOWN`; row 0 is the one with the least y.
        resolution: Edge of a cell, m.
        origin_world: (x, y) m: the corner of cell (0, 0).
    """

    cells: np.ndarray
    resolution: float
    origin_world: tuple[float, float]


def costmap(
    field: MapState | Field,
    *,
    floor_m: float,
    height_m: float,
    radius_m: float,
    step_m: float = 0.1,
    resolution: float = 0.05,
) -> Costmap:
    """Computes where a robot that drives on a level floor may be: free, occupied or unknown.

    The robot is a cylinder that stands on the floor. A cell is free if the cylinder may stand at
    any place in it, by the lower bound of the distances (`Query.lower`), and sees no unobserved
    space. It is occupied if a surface may be in reach, by the distances themselves, and unknown
    otherwise. All parts of a cell and of the samples around it count, so that coarse cells make
    obstacles larger, never smaller.

    Example:
        >>> grid = exports.costmap(field, floor_m=0.0, height_m=1.2, radius_m=0.3)

    Args:
        field: A map, or a snapshot of one. z is up.
        floor_m: Height of the floor, m, world frame.
        height_m: Height of the robot, m.
        radius_m: Radius of the robot, m.
        step_m: Surfaces up to this height above the floor are not obstacles, m; at least
            the resolution, or the floor itself would be an obstacle.
        resolution: Edge of a cell, m.

    Returns:
        The costmap of the whole map.

    Raises:
        ValueError: An argument has a wrong type, shape or value.
    """
    cell = check_resolution(resolution)
    floor = as_number("floor_m", floor_m)
    radius = as_number("radius_m", radius_m, 0)
    step = as_number("step_m", step_m, cell)
    height = as_number("height_m", height_m, step, above=True)
    field = as_live_field(field)
    low, high = np.asarray(field.config.bounds, float)
    bottom, top = floor + step, floor + height
    if bottom < low[2] or top > high[2]:
        raise ValueError(
            f"the robot reaches from {bottom:.2f} to {top:.2f} m, expected heights inside the map, "
            f"{low[2]:.2f} to {high[2]:.2f} m"
        )
    # Samples at the centers of cubes that fill the part of the map in which the robot moves.
    size = np.array([*(high - low)[:2], top - bottom])
    counts = np.maximum(np.ceil(size / cell - 1e-6), 2)
    corner = np.array([*low[:2], bottom])
    baked = bake(field, cell, center=corner + counts * cell / 2, size=(counts - 1) * cell)
    sdf, frontier, lower = (np.asarray(each) for each in (baked.sdf, baked.frontier, baked.lower))
    in_cube = math.sqrt(3) / 2 * cell  # from the center of a cube to its corner
    observed = frontier + in_cube > 0  # `bake` has reduced it by as much
    occupied = (observed & (sdf <= in_cube)).any(axis=2)
    doubtful = ((frontier <= 0) | (lower <= in_cube)).any(axis=2)
    # The robot may be anywhere in its cell, and the obstacle anywhere in its own.
    reach = radius + math.sqrt(2) * cell
    cells = np.full(occupied.shape, FREE, np.uint8)
    cells[_within(doubtful, reach / cell)] = UNKNOWN
    cells[_within(occupied, reach / cell)] = OCCUPIED
    beyond = _within_of_edge(cells.shape, reach / cell)
    cells[beyond & (cells == FREE)] = UNKNOWN
    return Costmap(cells.T, cell, (float(low[0]), float(low[1])))


def write_costmap(path: str | os.PathLike[str], grid: Costmap) -> None:
    """Writes a costmap as an image (`.pgm`) and its description (`.yaml`), side by side.

    Args:
        path: One of the two; the other has the other suffix.
        grid: The costmap.

    Raises:
        OSError: A file cannot be written.

    Example:
        grid = exports.costmap(field, floor_m=0.0, height_m=1.2, radius_m=0.3)
        exports.write_costmap("floor.yaml", grid)  # and floor.pgm
    """
    image, description = Path(path).with_suffix(".pgm"), Path(path).with_suffix(".yaml")
    rows, columns = grid.cells.shape
    with replacing(image) as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        file.write(np.ascontiguousarray(grid.cells[::-1]).tobytes())  # the first row is the upper
    x, y = grid.origin_world
    name = image.name.replace("'", "''")
    with replacing(description) as file:
        file.write(
            f"image: '{name}'\nmode: trinary\nresolution: {grid.resolution!r}\n"
            f"origin: [{x!r}, {y!r}, 0.0]\nnegate: 0\n"
            f"occupied_thresh: {_OCCUPIED_FROM}\nfree_thresh: {_FREE_BELOW}\n".encode()
        )


def _within(mask: np.ndarray, cells: float) -> np.ndarray:
    """The cells whose centers are within a distance, in cells, of the centers of a mask."""
    from scipy.ndimage import distance_transform_edt

    if not mask.any():
        return mask
    return np.asarray(distance_transform_edt(~mask)) <= cells + 1e-6


def _within_of_edge(shape: tuple[int, ...], cells: float) -> np.ndarray:
    """The cells within a distance, in cells, of the outside of the map."""
    steps = [np.minimum(np.arange(count) + 1, np.arange(count, 0, -1)) for count in shape]
    return np.minimum(steps[0][:, None], steps[1][None]) <= cells
