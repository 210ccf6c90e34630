"""Signed distances to the solids that geoms describe, exact or bounded, in their own frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from hiosdf_jax._src.planning.robot.cover import SignedDistance

# Relative error that the search for the nearest point of a mesh may make.
_SEARCH = 0.01

# Most nodes of the lattice that separates a mesh's inside, if half the tolerance is fine enough.
_MOST_NODES = 3_000_000


def cylinder(radius: float, half_length: float) -> SignedDistance:
    """Returns the signed distance to a cylinder along z.

    Args:
        radius: m.
        half_length: m.

    Returns:
        The distance; both bounds are exact.
    """

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value = distance_beyond(cylinder_profile(points, radius, half_length))
        return value, value

    return distance


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
    outside = np.maximum(faces, 0)
    return np.sqrt(np.einsum("ij,ij->i", outside, outside)) + np.minimum(faces.max(axis=1), 0)


def ellipsoid(semi_axes: np.ndarray) -> SignedDistance:
    """Returns the signed distance to an ellipsoid.

    Args:
        semi_axes: (3,) m.

    Returns:
        The distance; both bounds are exact to 1e-6 of the largest axis.
    """
    squares = semi_axes**2
    least = squares.min()

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    return distance


def mesh(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> SignedDistance:
    """Returns bounds of the signed distance to a triangle mesh and all that it encloses.

    An open mesh is a sheet. Hollows are enclosed if only gaps narrower than half the tolerance lead
    to them.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) indices.
        tolerance: Tolerance of the cover that needs the bounds, m.

    Returns:
        The distance; the bounds are some tenths of the tolerance apart.
    """
    # Imported here: a robot that loads its spheres from a file needs none of them.
    import trimesh
    from scipy import ndimage
    from scipy.spatial import KDTree

    # Each point of a triangle is within its longest edge / sqrt(3) of one of its corners.
    edge = tolerance / 10
    longest = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max()
    rounds = int(np.ceil(np.log2(max(longest / edge, 1)))) + 2
    fine = trimesh.remesh.subdivide_to_size(vertices, faces, edge, max_iter=rounds)[0]
    error = edge / np.sqrt(3)
    tree = KDTree(fine)

    # Neighbors on a lattice are on the same side if the surface is farther from one of them than
    # half their distance. What is not connected to the outside is enclosed.
    extents = fine.max(axis=0) - fine.min(axis=0)
    affordable = (np.prod(extents + tolerance) / _MOST_NODES) ** (1 / 3)
    pitch = float(np.clip(affordable, tolerance / 10, tolerance / 2))
    corner = fine.min(axis=0) - 3 * pitch
    counts = np.ceil((fine.max(axis=0) - corner) / pitch).astype(int) + 4
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    nodes = corner + pitch * index.reshape(-1, 3)
    gap = (
        np.asarray(tree.query(nodes, distance_upper_bound=2 * pitch, workers=-1)[0]).reshape(counts)
        - error
    )
    labeled: Any = ndimage.label(gap > pitch / 2)
    regions = np.asarray(labeled[0])
    enclosed = (regions != regions[0, 0, 0]) & (regions > 0)
    outside = regions == regions[0, 0, 0]

    def distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Approximate: exact searches from deep inside are slow.
        far = np.asarray(tree.query(points, eps=_SEARCH, workers=-1)[0])
        near = np.maximum(far / (1 + _SEARCH) - error, 0)
        node = np.rint((points - corner) / pitch).astype(int)
        within = np.all((node >= 0) & (node < counts), axis=1)
        x, y, z = np.where(within[:, None], node, 0).T
        # A point is on its node's side if the surface is farther than the node.
        decided = np.linalg.norm(points - (corner + pitch * np.stack([x, y, z], -1)), axis=1) < near
        is_in = within & decided & enclosed[x, y, z]
        is_out = ~within | (decided & outside[x, y, z])
        return np.where(is_out, near, -far), np.where(is_in, -near, far)

    return distance
