"""Signed distances to the solids that geoms describe, exact or bounded, in their own frames."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from hiosdf_jax._src.planning.robot.cover import DistanceBounds, Solid, lengths

# Relative error that the search for the nearest point of a mesh may make.
_SEARCH = 0.01

# Tolerance over the distance from a point of a mesh to the nearest sample of it.
_SAMPLES_PER_TOLERANCE = 16

# Most cells of the lattice that separates a mesh's inside, if half the tolerance is fine enough.
_MOST_CELLS = 3_000_000


def cylinder(radius: float, half_length: float) -> Solid:
    """Returns the signed distance to a cylinder along z.

    Args:
        radius: m.
        half_length: m.

    Returns:
        The distance; both bounds are exact.
    """

    def distance(points: np.ndarray) -> DistanceBounds:
        value = distance_beyond(cylinder_profile(points, radius, half_length))
        return value, value

    return Solid(distance, distance, distance)


def cylinder_profile(points: np.ndarray, radius: float, half_length: float) -> np.ndarray:
    """Computes how far points are beyond the side and the ends of a cylinder along z.

    Args:
        points: (N, 3) m.
        radius: m.
        half_length: m.

    Returns:
        (N, 2) m, radial and axial; negative inside.
    """
    radial = np.hypot(points[:, 0], points[:, 1]) - radius
    return np.stack([radial, np.abs(points[:, 2]) - half_length], axis=1)


def distance_beyond(faces: np.ndarray) -> np.ndarray:
    """Computes the signed distance to a solid with orthogonal faces, such as a box or a cylinder.

    Args:
        faces: (N, K) m, signed distance beyond each pair of faces.

    Returns:
        (N,) m.
    """
    return lengths(np.maximum(faces, 0)) + np.minimum(faces.max(axis=1), 0)


def ellipsoid(semi_axes: np.ndarray) -> Solid:
    """Returns the signed distance to an ellipsoid.

    Args:
        semi_axes: (3,) m.

    Returns:
        The distance; both bounds are exact to 1e-6 of the largest axis.
    """
    squares = semi_axes**2
    least = squares.min()

    def distance(points: np.ndarray) -> DistanceBounds:
        # The nearest point is r_k^2 p_k / (t + r_k^2) for the t > -min r^2 that puts it on the
        # surface. Off the planes of symmetry exactly one such t exists.
        p = np.maximum(np.abs(points), 1e-9 * semi_axes.max())
        low = np.full(len(p), -least)
        high = np.linalg.norm(semi_axes * p, axis=1)
        for _ in range(80):
            middle = (low + high) / 2
            with np.errstate(divide="ignore"):
                ratio = np.sum((semi_axes * p / (middle[:, None] + squares)) ** 2, axis=1)
            low, high = np.where(ratio > 1, middle, low), np.where(ratio > 1, high, middle)
        nearest = squares * p / np.maximum(high[:, None] + squares, 1e-300)
        value = np.linalg.norm(p - nearest, axis=1) * np.where(high > 0, 1, -1)
        return value, value

    return Solid(distance, distance, distance)


def mesh(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> Solid:
    """Returns bounds of the signed distance to a triangle mesh and all that it encloses.

    An open mesh is a sheet. Gaps narrower than a tenth of the tolerance count as closed, gaps wider
    than 1.5 tolerances as open.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) indices.
        tolerance: Tolerance of the cover that needs the bounds, m.

    Returns:
        The distance; the bounds are some tenths of the tolerance apart.
    """
    # Imported here: a robot that loads its spheres from a file needs none of them.
    from scipy import ndimage
    from scipy.spatial import KDTree

    error = tolerance / _SAMPLES_PER_TOLERANCE
    samples = _on_triangles(vertices[faces], error)
    tree = KDTree(samples, leafsize=32, balanced_tree=False)
    low, high = samples.min(axis=0), samples.max(axis=0)

    # Connected cells that the surface does not touch are on the same side of it. What is not
    # connected to the outside is enclosed.
    affordable = (np.prod(high - low + tolerance) / _MOST_CELLS) ** (1 / 3)
    pitch = float(np.clip(affordable, 2 * error, tolerance / 2))
    corner = low - 3 * pitch
    counts = np.ceil((high - corner) / pitch).astype(int) + 3
    touched = np.zeros(counts, bool)
    for offset in itertools.product((-error, error), repeat=3):
        touched[tuple(((samples + offset - corner) / pitch).astype(int).T)] = True
    labeled: Any = ndimage.label(~touched)
    regions = np.asarray(labeled[0])
    side = np.where(regions == regions[0, 0, 0], 1, -1).astype(np.int8)
    side[touched] = 0
    steps: Any = ndimage.distance_transform_edt(~touched)
    # The surface touches a cell, or is farther from its center than half the diagonal by `error`
    # along each axis.
    half_diagonal = np.sqrt(3) * pitch / 2
    slack = half_diagonal + np.sqrt(3) * error

    def signed(points: np.ndarray, near: np.ndarray, far: np.ndarray) -> DistanceBounds:
        """Bounds of the signed distance by those of the distance."""
        place = (points - corner) / pitch
        cell = np.floor(place).astype(int)
        sign = np.where(np.all((cell >= 0) & (cell < counts), axis=1), 0, 1)
        cell = np.clip(cell, 0, counts - 1)
        sign = np.where(sign == 0, side[tuple(cell.T)], sign)
        # A point of a touched cell is on the side of the next cell if that is nearer than the
        # surface.
        rows = np.nonzero(sign == 0)[0]
        for axis, step in itertools.product(range(3), (-1, 1)):
            part = place[rows, axis] - cell[rows, axis]
            beside = cell[rows].copy()
            beside[:, axis] = np.clip(beside[:, axis] + step, 0, counts[axis] - 1)
            gap = pitch * (1 - part if step > 0 else part)
            sign[rows] = np.where(gap < near[rows], side[tuple(beside.T)], sign[rows])
            rows = rows[sign[rows] == 0]
        return np.where(sign > 0, near, -far), np.where(sign < 0, -near, far)

    def tight(points: np.ndarray) -> DistanceBounds:
        # Approximate: exact searches from deep inside are slow.
        far = np.asarray(tree.query(points, eps=_SEARCH)[0])
        return signed(points, np.maximum(far / (1 + _SEARCH) - error, 0), far)

    def bound(points: np.ndarray) -> DistanceBounds:
        """Bounds of the distance by the lattice and the box around the mesh."""
        cell = np.clip(((points - corner) / pitch).astype(int), 0, counts - 1)
        offset = lengths(points - (corner + pitch * (cell + 0.5)))
        center = pitch * np.asarray(steps)[tuple(cell.T)]
        box = lengths(np.maximum(np.maximum(low - points, points - high), 0))
        near = np.maximum(np.maximum(center - offset - half_diagonal, box - error), 0)
        return near, center + offset + slack

    def quick(points: np.ndarray) -> DistanceBounds:
        near, far = bound(points)
        # Cheap where the surface is close, which is where it matters.
        close = np.nonzero(near < pitch)[0]
        if len(close):
            most = float(far[close].max())
            found = tree.query(points[close], distance_upper_bound=most)[0]
            far[close] = np.minimum(far[close], found)
            near[close] = np.maximum(near[close], far[close] - error)
        return signed(points, near, far)

    def rough(points: np.ndarray) -> DistanceBounds:
        return signed(points, *bound(points))

    return Solid(tight, quick, rough)


def _on_triangles(triangles: np.ndarray, error: float) -> np.ndarray:
    """Samples triangles (F, 3, 3) m: each of their points is within `error` of a sample."""
    # Rows along the longest edge. Seen from a point between two rows, the row nearer to that edge
    # is opposite.
    lengths = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    first = lengths.argmax(axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, order[:, :, None], axis=1).transpose(1, 0, 2)
    edge = lengths.max(axis=1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    height = area / np.maximum(edge, 1e-300)
    rows = np.ceil(height * np.sqrt(2) / error).astype(int) + 1
    face, row = _repeated(rows)
    t = (row / np.maximum(rows[face] - 1, 1))[:, None]
    start, end = a[face] + t * (c - a)[face], b[face] + t * (c - b)[face]
    count = np.ceil(np.linalg.norm(end - start, axis=1) / (np.sqrt(2) * error)).astype(int) + 1
    line, k = _repeated(count)
    s = (k / np.maximum(count[line] - 1, 1))[:, None]
    return start[line] + s * (end - start)[line]


def _repeated(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Repeats each index as often as its count says, and numbers the repetitions from 0."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
