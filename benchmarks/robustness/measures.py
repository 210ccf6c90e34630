"""Scores of a map in a world that is known exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

import hiosdf_jax as hio
from benchmarks.robustness import library
from benchmarks.robustness.sensors import Scan, Sensor
from benchmarks.robustness.worlds import Thing, World, bounding_box, draw_inside, thing_distance

Figures = dict[str, float]

DEEP = 0.05  # m, a point that far inside a thing must be solid
_INSIDE_POINTS = 4000
_WAYPOINTS = 500
_WAYPOINT_HEIGHT = 0.3  # m; nearer to the floor the shortest way out of a thing is downward
_MARGIN = 0.05  # m, waypoints with less clearance are pushed
_STEP, _STEPS, _MOMENTUM = 0.02, 100, 0.9  # m
_TOLERATED = 0.02  # m
_WAY_OUT = 0.4  # m, the center of the boxes is 0.25 m from the nearest side
_OLD_PLACE_POINTS = 4000
_REACHED = 0.9  # of the true distance
_SEEN_POINTS = 20_000
_LOOKS = 12  # scans that are searched for the nearest surface of a point
_VIEW = 0.0125  # rad, as near to a ray a surface counts as seen
_GAP = 0.0175  # rad, half the gap between the rings of the LiDAR: nothing between them is unseen
_TOUCH = 0.01  # m, a ray that comes as near to a point has met it
_MET = 0.15  # m, a return as near to a surface has met it; none ends on one that is seen edge-on
_DIFFERENCE = 1e-5  # m
_WAKE_POINTS = 20_000
_WAKE_TRUTH = 0.05  # m; nearer to the thing an error of its side would count
_SWEPT_POINTS = 8_000
_GHOST_TRUTH, _GHOST_SDF = 0.15, 0.05  # m, free space that is called surface
_KEPT = 0.02  # m


def solidity(state: hio.MapState, thing: Thing, rng: np.random.Generator) -> Figures:
    """Scores how solid a thing is.

    Args:
        state: The map.
        thing: A thing that is in the world.
        rng: Source of randomness.

    Returns:
        `solid` and `solid_lower`, the shares of its inside deeper than 5 cm with sdf < 0 under
        unknown="obstacle" and with lower < 0. `outward`, the share of waypoints in it with sdf < 0
        that reach the outside within 40 cm along the gradient. `pushed_out`, the share of waypoints
        that are outside after they follow the gradient until they are 5 cm clear. The outside
        begins 2 cm below the surface.
    """
    inside = draw_inside(thing, _INSIDE_POINTS, DEEP, rng)
    waypoints = draw_inside(thing, 2 * _WAYPOINTS, DEEP, rng)
    waypoints = waypoints[waypoints[:, 2] > _WAYPOINT_HEIGHT][:_WAYPOINTS]
    pushed = _push(state, waypoints)
    return {
        "solid": float(np.mean(library.solid_sdf(state, inside) < 0)),
        "solid_lower": float(np.mean(library.lower(state, inside) < 0)),
        "outward": float(np.mean(_point_outward(state, thing, waypoints))),
        "pushed_out": float(np.mean(thing_distance(thing, pushed) > -_TOLERATED)),
    }


def _point_outward(state: hio.MapState, thing: Thing, points: np.ndarray) -> np.ndarray:
    """A mask of the points that collide and whose gradient leads straight out of a thing."""
    sdf, grad = library.solid_sdf_and_grad(state, points)
    unit = grad / np.maximum(np.linalg.norm(grad, axis=1, keepdims=True), 1e-9)
    ends = [points + length * unit for length in np.linspace(0.1, 1, 10) * _WAY_OUT]
    leaves = [thing_distance(thing, each) > -_TOLERATED for each in ends]
    return (sdf < 0) & np.any(leaves, axis=0)


def _push(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Moves points up the gradient, with the momentum of an optimizer, until they are clear."""
    velocity = np.zeros_like(points)
    for _ in range(_STEPS):
        sdf, grad = library.solid_sdf_and_grad(state, points)
        unit = grad / np.maximum(np.linalg.norm(grad, axis=1, keepdims=True), 1e-9)
        velocity = _MOMENTUM * velocity + (1 - _MOMENTUM) * unit
        points = points + np.where(sdf < _MARGIN, _STEP, 0)[:, None] * velocity
    return points


def visible_side(state: hio.MapState, scans: Sequence[Scan], things: Sequence[int]) -> Figures:
    """Scores the surface of things where scans saw it.

    Args:
        state: The map.
        scans: Scans of the world as it is now.
        things: Indices of the things in the world; `BACKGROUND` for the rest.

    Returns:
        `side_cm` and `side_network_cm`, mean |sdf| of the map and of the network alone, and
        `side_lower`, the share of it where lower <= 1 cm.
    """
    points = np.concatenate([each.exact_world[np.isin(each.hit, things)] for each in scans])
    if not len(points):
        return {"side_cm": np.nan, "side_network_cm": np.nan, "side_lower": np.nan}
    return {
        "side_cm": 100 * float(np.mean(np.abs(library.sdf(state, points)))),
        "side_network_cm": 100 * float(np.mean(np.abs(library.network_sdf(state, points)))),
        "side_lower": float(np.mean(library.lower(state, points) <= 0.01)),
    }


def draw_old_place(
    world: World,
    things: Sequence[Thing],
    rng: np.random.Generator,
    least: float = 0.0,
    sensor: Sensor | None = None,
    scans: Sequence[Scan] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Draws points of the place that a thing has left.

    Nothing can be known of a part of it that lies outside a sensor's field of view.

    Args:
        world: The world without it there.
        things: The parts of the thing where they were.
        rng: Source of randomness.
        least: m, points nearer to any surface do not count.
        sensor: The sensor that looked there; by default all of the place counts.
        scans: Its scans of the world as it is now.

    Returns:
        Points (n, 3) m and exact distances (n,) m.
    """
    points = np.concatenate([draw_inside(each, _OLD_PLACE_POINTS, 0.0, rng) for each in things])
    if sensor is not None:
        poses = [each.pose for each in scans]
        points = points[is_visible(sensor, poses, world, points, _GAP)]
    truth = world.distance(points)
    return points[truth >= least], truth[truth >= least]


def old_place(state: hio.MapState, points: np.ndarray, truth: np.ndarray) -> Figures:
    """Scores the place that a thing has left.

    Args:
        state: The map.
        points: Points of the place, (n, 3) m.
        truth: Exact distances without the thing, (n,) m.

    Returns:
        `old`, `old_lower` and `old_network`, the shares of the place where the map, its lower bound
        and the network alone reach 90 % of the true distance.
    """
    needed = _REACHED * truth
    return {
        "old": float(np.mean(library.sdf(state, points) >= needed)),
        "old_lower": float(np.mean(library.lower(state, points) >= needed)),
        "old_network": float(np.mean(library.network_sdf(state, points) >= needed)),
    }


def seen_points(
    sensor: Sensor, scans: Sequence[Scan], world: World, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draws points of free space on the rays of scans, where the nearest surface was seen too.

    Nothing can be known of a surface that no ray has met, so no map can be scored on it. A surface
    counts as met up to 15 cm from a return: not the floor between distant rings of a LiDAR.

    Args:
        sensor: The sensor.
        scans: Scans of the world as it is now.
        world: The world as it is now.
        rng: Source of randomness.

    Returns:
        Points (n, 3) m and exact distances (n,) m.
    """
    per_scan = -(-_SEEN_POINTS // len(scans))
    parts = []
    for each in scans:
        ends = each.exact_world[rng.integers(len(each.exact_world), size=per_scan)]
        start = each.pose[:3, 3]
        parts.append(start + rng.uniform(size=(per_scan, 1)) * (ends - start))
    points = np.concatenate(parts)
    truth = world.distance(points)
    nearest = points - truth[:, None] * _gradient(world, points)
    poses = [each.pose for each in scans[:: -(-len(scans) // _LOOKS)]]
    met = KDTree(np.concatenate([each.exact_world for each in scans])).query(nearest)[0] < _MET
    known = met & is_visible(sensor, poses, world, nearest)
    return points[known], truth[known]


def is_visible(
    sensor: Sensor,
    poses: Sequence[np.ndarray],
    world: World,
    points: np.ndarray,
    view: float = _VIEW,
) -> np.ndarray:
    """Returns a mask of the points, on surfaces or in free space, that a sensor sees.

    Args:
        sensor: The sensor.
        poses: (4, 4) T_world_sensor each.
        world: The world.
        points: (n, 3) m.
        view: rad, the largest angle between a point and a ray.

    Returns:
        (n,) bool; seen from one pose suffices.
    """
    tree = KDTree(sensor.directions)
    visible = np.full(len(points), False)
    for pose in poses:
        rays = points - pose[:3, 3]
        ranges = np.linalg.norm(rays, axis=1)
        directions = rays / np.maximum(ranges, 1e-9)[:, None]
        in_view = tree.query(directions @ pose[:3, :3])[0] < view
        visible |= in_view & (world.cast(pose[:3, 3], directions)[0] > ranges - _TOUCH)
    return visible


def _gradient(world: World, points: np.ndarray) -> np.ndarray:
    sides = [
        world.distance(points + offset) - world.distance(points - offset)
        for offset in _DIFFERENCE * np.eye(3)
    ]
    return np.stack(sides, axis=1) / (2 * _DIFFERENCE)


def bounds_hold(state: hio.MapState, points: np.ndarray, truth: np.ndarray) -> Figures:
    """Scores the lower bounds of seen points.

    Args:
        state: The map.
        points: (n, 3) m.
        truth: (n,) m.

    Returns:
        `coverage`, the share of the bounds that hold, and `slack_cm`, the mean distance between
        truth and bound.
    """
    slack = truth - library.lower(state, points)
    return {"coverage": float(np.mean(slack >= 0)), "slack_cm": 100 * float(np.mean(slack))}


def errors(state: hio.MapState, points: np.ndarray, truth: np.ndarray) -> Figures:
    """Scores the distance at points: `error_cm`, mean |map - truth|, and `bias_cm`, its mean."""
    error = library.sdf(state, points) - truth
    return {
        "error_cm": 100 * float(np.mean(np.abs(error))),
        "bias_cm": 100 * float(np.mean(error)),
    }


class Wake:
    """Measures what a moving thing leaves behind, and how well its side is seen."""

    def __init__(self, placements: Sequence[Thing], lag: int, rng: np.random.Generator) -> None:
        """Draws points where the thing will be.

        Args:
            placements: The thing at each update.
            lag: Updates after which a place that the thing has left must be free.
            rng: Source of randomness.
        """
        corners = [bounding_box(each) for each in placements]
        low = np.min([corner[0] for corner in corners], axis=0)
        high = np.max([corner[1] for corner in corners], axis=0)
        points = rng.uniform(low, high, (_WAKE_POINTS, 3))
        inside = np.stack([thing_distance(each, points) < 0 for each in placements])
        kept = inside.any(axis=0)
        self._points, self._inside = points[kept], inside[:, kept]
        self._own = float(np.mean(inside[0]) * _WAKE_POINTS)
        self._lag = lag
        self._ghosts: list[float] = []
        self._sides_cm: list[float] = []

    def look(self, state: hio.MapState, update: int, world: World, seen: Scan) -> None:
        """Scores the map after an update.

        Args:
            state: The map.
            update: Its number.
            world: The world at that moment; its first thing is the one that moves.
            seen: The scan of it.
        """
        left = self._inside[: max(update - self._lag + 1, 0)].any(axis=0)
        free = self._points[left & (world.distance(self._points) > _WAKE_TRUTH)]
        side = seen.exact_world[seen.hit == 0]
        sdf = library.sdf(state, np.concatenate([free, side]))
        self._ghosts.append(np.count_nonzero(sdf[: len(free)] < 0) / self._own)
        if len(side):
            self._sides_cm.append(100 * float(np.mean(np.abs(sdf[len(free) :]))))

    def figures(self) -> Figures:
        """Scores over all updates.

        Returns:
            `side_cm`, mean over the updates of mean |sdf| on the side that each scan saw;
            `worst_side_cm`, its maximum; `ghost`, the volume with sdf < 0 behind the thing as a
            share of its own, mean over the updates; `worst_ghost`, its maximum.
        """
        return {
            "side_cm": float(np.mean(self._sides_cm)),
            "worst_side_cm": float(np.max(self._sides_cm)),
            "ghost": float(np.mean(self._ghosts)),
            "worst_ghost": float(np.max(self._ghosts)),
        }


def ghosts(
    state: hio.MapState, world: World, swept: Sequence[Thing], rng: np.random.Generator
) -> Figures:
    """Scores the free places that the robot's own body has been in.

    Args:
        state: The map.
        world: The world without the robot.
        swept: The parts of the robot in all their poses.
        rng: Source of randomness.

    Returns:
        `arm_ghost`, the share of these places with sdf < 5 cm where the true distance is more
        than 15 cm.
    """
    per_part = -(-_SWEPT_POINTS // len(swept))
    points = np.concatenate([draw_inside(each, per_part, 0.0, rng) for each in swept])
    free = points[world.distance(points) > _GHOST_TRUTH]
    return {"arm_ghost": float(np.mean(library.sdf(state, free) < _GHOST_SDF))}


def kept(state: hio.MapState, scans: Sequence[Scan], things: Sequence[int]) -> Figures:
    """Scores whether the surfaces of things are in the map.

    Args:
        state: The map.
        scans: Scans of the world as it is now.
        things: Indices of the things in the world.

    Returns:
        `kept`, the share of the surface that scans saw with sdf <= 2 cm.
    """
    points = np.concatenate([each.exact_world[np.isin(each.hit, things)] for each in scans])
    return {"kept": float(np.mean(library.sdf(state, points) <= _KEPT))}


class RowCounts:
    """Counts how well the rows of moving things are recognized."""

    def __init__(self) -> None:
        """Starts with no rows."""
        self._found = self._called = self._moving = 0
        self._known = False

    def look(self, called: np.ndarray | None, seen: Scan) -> None:
        """Counts the rows of one cloud.

        Args:
            called: (n,) bool, the rows that the map calls moving; None if it does not say.
            seen: The scan; the first thing of its world is the one that moves.
        """
        if called is None:
            return
        self._known = True
        returned = np.isfinite(seen.cloud).all(axis=1)
        moving = returned & (seen.hit == 0)
        self._found += int(np.count_nonzero(called & moving))
        self._called += int(np.count_nonzero(called & returned))
        self._moving += int(np.count_nonzero(moving))

    def figures(self) -> Figures:
        """`row_recall` and `row_precision`; nothing if the map does not say which rows move."""
        if not self._known:
            return {}
        return {
            "row_recall": self._found / max(self._moving, 1),
            "row_precision": self._found / max(self._called, 1),
        }


def error_ratio(
    state: hio.MapState, clean: hio.MapState, points: np.ndarray, truth: np.ndarray
) -> Figures:
    """Compares a map with one that nothing happened to.

    Args:
        state: The map.
        clean: The map of the same stream without the thing or the fault.
        points: (n, 3) m.
        truth: (n,) m.

    Returns:
        `error_ratio`, mean |map - truth| over that of the clean map, and `bias_cm`, the mean of
        map - truth.
    """
    mine, other = errors(state, points, truth), errors(clean, points, truth)
    return {
        "error_ratio": mine["error_cm"] / other["error_cm"],
        "bias_cm": mine["bias_cm"],
    }
