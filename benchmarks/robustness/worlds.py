"""Worlds of boxes and capsules in a room, with exact distances and a ray caster in numpy.

Distances to a union are exact outside of solids. Inside they are exact where solids do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

BACKGROUND = -1  # what a ray hit if it hit none of the things


class Box(NamedTuple):
    """A solid box, rotated about the vertical axis.

    Attributes:
        center: (x, y, z) m.
        half: Half its edges, m.
        yaw: Rotation about z, rad.
    """

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw: float = 0.0


class Capsule(NamedTuple):
    """All points within a radius of a segment.

    Attributes:
        start: (x, y, z) m.
        end: (x, y, z) m.
        radius: m.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


Thing = Box | Capsule


class Background(Protocol):
    """What stands still around the things."""

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Ranges (n,) m along unit directions (n, 3); inf where a ray hits nothing."""
        ...

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (n,) m at points (n, 3) m, positive in free space."""
        ...


class Room(NamedTuple):
    """A closed room with furniture in it.

    Attributes:
        low: Corner of its free space, m.
        high: The opposite corner, m.
        furniture: What stands in it.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    furniture: tuple[Thing, ...] = ()

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        _, walls = _slabs(origin, directions, np.array(self.low), np.array(self.high))
        return _nearest_hit(walls, self.furniture, origin, directions)[0]

    def distance(self, points: np.ndarray) -> np.ndarray:
        middle, half = (
            np.add(self.low, self.high) / 2,
            np.subtract(self.high, self.low) / 2,
        )
        walls = -_cornered(np.abs(points - middle) - half)
        return _least_distance(walls, self.furniture, points)


class World(NamedTuple):
    """A background, and things that may differ from moment to moment.

    Attributes:
        background: What stands still.
        things: Everything else.
    """

    background: Background
    things: tuple[Thing, ...] = ()

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays.

        Args:
            origin: (3,) m, outside of all solids.
            directions: (n, 3) unit vectors.

        Returns:
            Ranges (n,) m, and which thing each ray hit, (n,) int, or `BACKGROUND`.
        """
        behind = self.background.cast(origin, directions)
        return _nearest_hit(behind, self.things, origin, directions)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (n,) m at points (n, 3) m, positive in free space."""
        return _least_distance(self.background.distance(points), self.things, points)


def thing_distance(thing: Thing, points: np.ndarray) -> np.ndarray:
    """Computes the exact signed distance to one thing.

    Args:
        thing: The thing.
        points: (n, 3) m.

    Returns:
        (n,) m, negative inside.
    """
    if isinstance(thing, Box):
        return _cornered(np.abs(_turn(points - thing.center, thing.yaw)) - thing.half)
    start, axis, length_squared = _segment(thing)
    offsets = points - start
    along = np.clip(offsets @ axis / length_squared, 0, 1) if length_squared else 0 * points[:, 0]
    return np.linalg.norm(offsets - along[:, None] * axis, axis=1) - thing.radius


def draw_inside(thing: Thing, count: int, depth: float, rng: np.random.Generator) -> np.ndarray:
    """Draws points uniformly in a thing.

    Args:
        thing: The thing.
        count: Number of points.
        depth: m, the least distance to its surface.
        rng: Source of randomness.

    Returns:
        (count, 3) m.
    """
    low, high = bounding_box(thing)
    drawn = np.empty((0, 3))
    while len(drawn) < count:
        points = rng.uniform(low, high, (4 * count, 3))
        drawn = np.concatenate([drawn, points[thing_distance(thing, points) <= -depth]])
    return drawn[:count]


def bounding_box(thing: Thing) -> tuple[np.ndarray, np.ndarray]:
    """Two corners (3,) m of the axis-aligned box around a thing."""
    if isinstance(thing, Box):
        cos, sin = abs(np.cos(thing.yaw)), abs(np.sin(thing.yaw))
        x, y, z = thing.half
        reach = np.array([cos * x + sin * y, sin * x + cos * y, z])
        return thing.center - reach, thing.center + reach
    ends = np.array([thing.start, thing.end])
    return ends.min(axis=0) - thing.radius, ends.max(axis=0) + thing.radius


def _nearest_hit(
    ranges: np.ndarray, things: Sequence[Thing], origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    hit = np.full(len(directions), BACKGROUND)
    for index, thing in enumerate(things):
        at = _cast_thing(thing, origin, directions)
        nearer = at < ranges
        ranges, hit = np.where(nearer, at, ranges), np.where(nearer, index, hit)
    return ranges, hit


def _least_distance(
    distance: np.ndarray, things: Sequence[Thing], points: np.ndarray
) -> np.ndarray:
    for thing in things:
        distance = np.minimum(distance, thing_distance(thing, points))
    return distance


def _cast_thing(thing: Thing, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ranges (n,) m at which rays enter a thing; inf where they miss it."""
    if isinstance(thing, Capsule):
        return _cast_capsule(thing, origin, directions)
    half = np.array(thing.half)
    local = _turn(np.subtract(origin, thing.center)[None], thing.yaw)[0]
    enter, leave = _slabs(local, _turn(directions, thing.yaw), -half, half)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def _cast_capsule(capsule: Capsule, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The first of the hits on the tube and on the two end spheres."""
    start, axis, length_squared = _segment(capsule)
    ranges = np.minimum(
        _cast_sphere(start, capsule.radius, origin, directions),
        _cast_sphere(start + axis, capsule.radius, origin, directions),
    )
    if not length_squared:
        return ranges
    # Across the axis the tube is a circle.
    offset = origin - start
    across = directions - np.outer(directions @ axis, axis) / length_squared
    offset_across = offset - (offset @ axis) * axis / length_squared
    a = np.einsum("ij,ij->i", across, across)
    b = across @ offset_across
    discriminant = b**2 - a * (offset_across @ offset_across - capsule.radius**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (-b - np.sqrt(discriminant)) / a
        along = (offset @ axis + at * (directions @ axis)) / length_squared
        on_tube = (discriminant > 0) & (at > 0) & (along >= 0) & (along <= 1)
    return np.where(on_tube, np.minimum(at, ranges), ranges)


def _cast_sphere(
    center: np.ndarray, radius: float, origin: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    offset = origin - center
    b = directions @ offset
    discriminant = b**2 - (offset @ offset - radius**2)
    at = -b - np.sqrt(np.maximum(discriminant, 0))
    return np.where((discriminant >= 0) & (at > 0), at, np.inf)


def _slabs(
    origin: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (n,) at which rays enter and leave a box; they miss it where enter > leave."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.stack([(low - origin) / directions, (high - origin) / directions])
    # A ray within a face is 0 / 0: it never crosses that face.
    first = np.where(np.isnan(at).any(axis=0), -np.inf, at.min(axis=0))
    last = np.where(np.isnan(at).any(axis=0), np.inf, at.max(axis=0))
    return first.max(axis=1), last.min(axis=1)


def _segment(capsule: Capsule) -> tuple[np.ndarray, np.ndarray, float]:
    start, axis = np.array(capsule.start), np.subtract(capsule.end, capsule.start)
    return start, axis, float(axis @ axis)


def _turn(vectors: np.ndarray, yaw: float) -> np.ndarray:
    """World vectors (n, 3) in a frame that is rotated by yaw about z."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return vectors @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _cornered(beyond: np.ndarray) -> np.ndarray:
    """Distance to a box; beyond (n, 3) is how far each point lies beyond its faces."""
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
