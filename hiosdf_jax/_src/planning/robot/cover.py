"""Covers of solids by few spheres that protrude by at most a tolerance.

The largest ball around c that protrudes no farther has radius tolerance - sdf(c). Capsules and
boxes have covers in closed form. For other solids such balls are chosen greedily until each cell of
a partition of the solid lies in one of them: the cover is complete by construction, not up to a
sampling.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

DistanceBounds = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds of the signed distance, (N,) m each."""


class Solid(NamedTuple):
    """A solid by bounds of the signed distance to it.

    Attributes:
        distance: (N, 3) m -> bounds.
        quick: The same for many points; may be looser far from the surface.
        rough: The same without a search; looser everywhere.
    """

    distance: Callable[[np.ndarray], DistanceBounds]
    quick: Callable[[np.ndarray], DistanceBounds]
    rough: Callable[[np.ndarray], DistanceBounds]


SphereCover = tuple[np.ndarray, np.ndarray]
"""Centers (S, 3) and radii (S,), m, float64."""

# Half diagonals of the smallest cells of the partition and of the grid of centers, relative to the
# tolerance. Finer cells need fewer spheres and more time.
_CELL = 1 / 8
_CENTER = 1 / 2
# Half diagonal over depth: deep inside, where the balls are large, cells may be larger too.
_CELL_BY_DEPTH = 3 / 8
# Most cells and centers per round of the greedy choice; rounds repeat until all are covered.
_MOST_CELLS = 12_000
_MOST_CENTERS = 4_000
_MOST_OWN = 500

_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


class _Ball(NamedTuple):
    """A ball, the cells in it, and the radius that it needs to contain each."""

    center: np.ndarray
    radius: float
    cells: np.ndarray
    needed: np.ndarray


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths (N,) of vectors (N, 3), several times as fast as `np.linalg.norm`."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def cover_capsule(radius: float, half_length: float, tolerance: float) -> SphereCover:
    """Covers a capsule by equal spheres in a row.

    Args:
        radius: m.
        half_length: Half the length of its axis, along z, m; 0 makes a sphere.
        tolerance: m, > 0.

    Returns:
        The spheres.
    """
    # With gaps of 2 g and the outer centers e from the ends of the axis, a sphere needs radius + e
    # at the ends and hypot(radius, g) between. With m gaps both are equal if
    # (m^2 - 1) e^2 + 2 (m^2 radius + half_length) e - half_length^2 = 0.
    gaps = 0
    inset = half_length
    while inset > tolerance:
        gaps += 1
        linear = 2 * (gaps**2 * radius + half_length)
        root = np.sqrt(linear**2 + 4 * (gaps**2 - 1) * half_length**2)
        inset = 2 * half_length**2 / (linear + root)
    centers = np.zeros((gaps + 1, 3))
    centers[:, 2] = np.linspace(inset - half_length, half_length - inset, gaps + 1)
    return centers, np.full(gaps + 1, radius + inset)


def cover_box(half: np.ndarray, tolerance: float) -> SphereCover:
    """Covers a box by spheres around the equal cells, with larger ones inside.

    Args:
        half: (3,) half the lengths of its edges, m.
        tolerance: m, > 0.

    Returns:
        The spheres.
    """
    # Candidate divisions, coarse to fine, whose edges divide one of the box's.
    finest = tolerance / 2
    sizes = np.unique(np.concatenate([h / np.arange(1, np.ceil(h / finest) + 2) for h in half]))
    for size in sizes[::-1]:
        counts = np.maximum(np.ceil(half / size - 1e-9).astype(int), 1)
        cell = half / counts  # half of a cell's edges
        radius = float(np.linalg.norm(cell))
        if radius - cell.min() <= tolerance:
            break
    else:
        raise AssertionError("cells of half the tolerance protrude less than the tolerance")
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(-1, 3)
    hollow = counts.min() >= 3
    if hollow:
        index = index[np.any((index == 0) | (index == counts - 1), axis=1)]
    centers, radii = (2 * index + 1 - counts) * cell, np.full(len(index), radius)
    if not hollow:
        return centers, radii
    # The inner cells form a box of their own. Its spheres may also fill the layer around it.
    inner_centers, inner_radii = cover_box(half - 2 * cell, tolerance + 2 * cell.min())
    return np.concatenate([centers, inner_centers]), np.concatenate([radii, inner_radii])


def cover_solid(
    solid: Solid,
    low: np.ndarray,
    high: np.ndarray,
    tolerance: float,
    check_time: Callable[[], None] = lambda: None,
) -> SphereCover:
    """Covers a solid given by its signed distance.

    Args:
        solid: The solid.
        low: (3,) m, low corner of a box that contains the solid.
        high: (3,) m, high corner.
        tolerance: m, > 0.
        check_time: Called now and then; may raise to stop.

    Returns:
        The spheres.
    """
    # Imported here: other covers do not need it.
    from scipy.spatial import KDTree

    random = np.random.default_rng(0)
    cells, reach = _partition(solid, low, high, _CELL * tolerance)
    check_time()
    tree = KDTree(cells, leafsize=128, balanced_tree=False)
    centers, size = _partition(solid, low, high, _CENTER * tolerance)
    # With the cells' corners, so that planes of symmetry carry centers.
    corners = (centers[:, None] + _CORNERS * size[:, None, None] / np.sqrt(3)).reshape(-1, 3)
    centers = _distinct(np.concatenate([centers, corners]), tolerance)
    radii = tolerance - _estimate(solid, centers)
    centers, radii = centers[radii >= tolerance], radii[radii >= tolerance]
    balls: list[_Ball] = []
    uncovered, left = np.ones(len(cells), bool), len(cells) + 1
    while uncovered.any():
        check_time()
        some = _draw(random, np.nonzero(uncovered)[0], _MOST_CELLS)
        # The ball around a cell's own center always contains the cell.
        tried = cells[_draw(random, some, _MOST_OWN)]
        if uncovered.sum() < left:
            left = uncovered.sum()
            rows = _draw(random, np.arange(len(centers)), _MOST_CENTERS)
            # Estimates suffice for a choice.
            largest = np.concatenate([radii[rows], tolerance - _estimate(solid, tried)])
            tried = np.concatenate([centers[rows], tried])
        else:  # they stalled it
            largest = tolerance - solid.distance(tried)[1]
        picked = tried[_choose(tried, largest, cells[some], reach[some])]
        for center, radius in zip(picked, tolerance - solid.distance(picked)[1], strict=True):
            near = np.asarray(tree.query_ball_point(center, radius), int)
            needed = lengths(cells[near] - center) + reach[near]
            held = needed <= radius
            if held.any():
                balls.append(_Ball(center, radius, near[held], needed[held]))
                uncovered[near[held]] = False
    return _tighten(balls, len(cells))


def _partition(
    solid: Solid, low: np.ndarray, high: np.ndarray, finest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cubes that contain a solid: centers (N, 3) and half diagonals (N,), at most `finest`."""
    edge = 2 * finest / np.sqrt(3)
    edge *= 2.0 ** max(0, np.floor(np.log2((high - low).min() / edge + 1e-12)))
    counts = np.maximum(np.ceil((high - low) / edge), 1)
    axes = [(np.arange(n) - (n - 1) / 2) * edge for n in counts]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + (low + high) / 2
    parts = []
    while len(centers):
        reach = edge * np.sqrt(3) / 2
        last = reach <= finest * (1 + 1e-9)
        least, greatest = solid.rough(centers)
        # A search pays where the bounds leave open whether a cube is needed or small enough.
        unsure = (least <= reach) & (greatest > (reach if last else -reach / _CELL_BY_DEPTH))
        least[unsure], greatest[unsure] = solid.quick(centers[unsure])
        touching = least <= reach
        centers, depth = centers[touching], -greatest[touching]
        done = last | (reach <= _CELL_BY_DEPTH * depth)
        parts.append((centers[done], np.full(done.sum(), reach)))
        centers = (centers[~done][:, None] + _CORNERS * edge / 4).reshape(-1, 3)
        edge /= 2
    return np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])


def _distinct(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Drops points that equal others up to a hundredth of the tolerance."""
    steps = np.rint((points - points.min(axis=0)) * (100 / tolerance)).astype(np.int64)
    return points[np.unique(steps @ [1, 1 << 21, 1 << 42], return_index=True)[1]]


def _estimate(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Signed distance midway between its quick bounds, (N,) m."""
    least, greatest = solid.quick(points)
    return (least + greatest) / 2


def _draw(random: np.random.Generator, index: np.ndarray, most: int) -> np.ndarray:
    """Draws at most `most` of the indices and keeps their order."""
    return index if len(index) <= most else np.sort(random.choice(index, most, replace=False))


def _choose(
    centers: np.ndarray, radii: np.ndarray, cells: np.ndarray, reach: np.ndarray
) -> list[int]:
    """Chooses balls greedily, starting at cells that only small balls contain."""
    order = np.argsort(-radii, kind="stable")
    centers, radii = centers[order], radii[order]
    # |center - cell|^2 <= (radius - reach)^2 as matrix products, each small enough for the cache
    # and for one thread.
    ball = [-2 * centers, (centers**2).sum(axis=1) - radii**2, np.ones(len(radii)), 2 * radii]
    cell = [cells, np.ones(len(cells)), (cells**2).sum(axis=1) - reach**2, reach]
    rows, columns = np.column_stack(cell), np.column_stack(ball)
    contains = np.empty((len(rows), len(columns)), bool)
    for start in range(0, len(rows), 8):
        np.less_equal(rows[start : start + 8] @ columns.T, 0, out=contains[start : start + 8])
    uncovered = contains.any(axis=1)
    gain = contains.sum(axis=0, dtype=np.int32)  # uncovered cells in each ball
    largest = radii[contains.argmax(axis=1)]  # the first ball that contains a cell
    picked = []
    for start in np.argsort(largest, kind="stable"):
        if uncovered[start]:
            able = np.nonzero(contains[start])[0]
            best = able[gain[able].argmax()]
            picked.append(int(order[best]))
            newly = np.nonzero(uncovered & contains[:, best])[0]
            uncovered[newly] = False
            gain -= contains[newly].sum(axis=0, dtype=np.int32)
    return picked


def _tighten(balls: list[_Ball], cells: int) -> SphereCover:
    """Drops redundant balls and shrinks the others."""
    times = np.zeros(cells, int)
    for ball in balls:
        times[ball.cells] += 1
    kept = []
    for ball in sorted(balls, key=lambda ball: ball.radius):
        if (times[ball.cells] > 1).all():
            times[ball.cells] -= 1
        else:
            kept.append(ball)
    # Each cell belongs to the ball with most room for it.
    room, needed = np.full(cells, -np.inf), np.zeros(cells)
    owner = np.zeros(cells, int)
    for k, ball in enumerate(kept):
        better = ball.radius - ball.needed > room[ball.cells]
        won = ball.cells[better]
        room[won], owner[won], needed[won] = (
            (ball.radius - ball.needed)[better],
            k,
            ball.needed[better],
        )
    smallest = np.zeros(len(kept))
    np.maximum.at(smallest, owner, needed)
    centers = np.stack([ball.center for ball in kept])
    return centers[smallest > 0], smallest[smallest > 0]
