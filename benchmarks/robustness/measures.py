"""Scores of a map in a world that is known exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

import hiosdf_jax as hio
from benchmarks.robustness import library
from benchmarks.robustness.sensors import Scan, Sensor
from benchmarks.robustness.worlds import Thing, World, draw_inside, thing_distance

Figures = dict[str, float]

DEEP = 0.05  # m, a point that far inside a thing must be solid
_INSIDE_POINTS = 4000
_WAYPOINTS = 500
_MARGIN = 0.05  # m, waypoints with less clearance are pushed
_STEP, _STEPS = 0.02, 50  # m; a waypoint has 1 m to leave a thing
_OLD_PLACE_POINTS = 4000
_REACHED = 0.9  # of the true distance
_SEEN_POINTS = 20_000
_LOOKS = 12  # scans that are searched for the nearest surface of a point
_VIEW = 0.07  # rad, half the largest angle between neighboring rays
_TOUCH = 0.01  # m, a ray that comes as near to a point has met it
_DIFFERENCE = 1e-5  # m
_GHOST_TRUTH, _GHOST_SDF = 0.15, 0.05  # m, free space that is called surface


def solidity(state: hio.MapState, thing: Thing, rng: np.random.Generator) -> Figures:
    """Scores how solid a thing is.

    Args:
        state: The map.
        thing: A thing that is in the world.
        rng: Source of randomness.

    Returns:
        `solid` and `solid_lower`, the shares of its inside deeper than 5 cm with sdf < 0 under
        unknown="obstacle" and with lower < 0; `pushed_out`, the share of waypoints in it that
        leave it if they follow the gradient while their clearance is less than 5 cm.
    """
    answers = library.ask(state, draw_inside(thing, _INSIDE_POINTS, DEEP, rng))
    waypoints = draw_inside(thing, _WAYPOINTS, DEEP, rng)
    pushed = library.push_out(state, waypoints, _MARGIN, _STEP, _STEPS)
    return {
        "solid": float(np.mean(answers.solid < 0)),
        "solid_lower": float(np.mean(answers.lower < 0)),
        "pushed_out": float(np.mean(thing_distance(thing, pushed) > 0)),
    }


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
    answers = library.ask(state, points)
    return {
        "side_cm": 100 * float(np.mean(np.abs(answers.sdf))),
        "side_network_cm": 100 * float(np.mean(np.abs(answers.network))),
        "side_lower": float(np.mean(answers.lower <= 0.01)),
    }


def old_place(state: hio.MapState, world: World, thing: Thing, rng: np.random.Generator) -> Figures:
    """Scores the place that a thing has left.

    Args:
        state: The map.
        world: The world without it there.
        thing: The thing where it was.
        rng: Source of randomness.

    Returns:
        `old`, `old_lower` and `old_network`, the shares of the place where the map, its lower bound
        and the network alone reach 90 % of the true distance.
    """
    points = draw_inside(thing, _OLD_PLACE_POINTS, 0.0, rng)
    needed = _REACHED * world.distance(points)
    answers = library.ask(state, points)
    return {
        "old": float(np.mean(answers.sdf >= needed)),
        "old_lower": float(np.mean(answers.lower >= needed)),
        "old_network": float(np.mean(answers.network >= needed)),
    }


def seen_points(
    sensor: Sensor, scans: Sequence[Scan], world: World, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draws points of free space on the rays of scans, where the nearest surface was seen too.

    Nothing can be known of a surface that no ray has met, so no map can be scored on it.

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
    known = is_visible(sensor, poses, world, nearest)
    return points[known], truth[known]


def is_visible(
    sensor: Sensor, poses: Sequence[np.ndarray], world: World, points: np.ndarray
) -> np.ndarray:
    """A mask of the surface points (n, 3) m that a sensor sees from one of some poses."""
    tree = cKDTree(sensor.directions)
    visible = np.full(len(points), False)
    for pose in poses:
        rays = points - pose[:3, 3]
        ranges = np.linalg.norm(rays, axis=1)
        directions = rays / np.maximum(ranges, 1e-9)[:, None]
        in_view = tree.query(directions @ pose[:3, :3])[0] < _VIEW
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
    slack = truth - library.ask(state, points).lower
    return {"coverage": float(np.mean(slack >= 0)), "slack_cm": 100 * float(np.mean(slack))}


def errors(state: hio.MapState, points: np.ndarray, truth: np.ndarray) -> Figures:
    """Scores the distance at points: `error_cm`, mean |map - truth|, and `bias_cm`, its mean."""
    error = library.ask(state, points).sdf - truth
    return {
        "error_cm": 100 * float(np.mean(np.abs(error))),
        "bias_cm": 100 * float(np.mean(error)),
    }
