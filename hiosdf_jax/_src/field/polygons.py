"""The surface patches of a grid as polygons that meet along the voxels' edges.

A patch is a plane with an extent. Its polygon is the part of the plane inside the patch's voxel,
cut to the extent of its hits. Where a neighbor continues the surface, both reach the common face of
their voxels and share corners there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.state.pytrees import NO_FEATURE, Surface

# A polygon covers this many standard deviations of the hits to each side, along each axis of the
# grid. Hits that cover a rectangle evenly reach 1.7; more draws surfaces beyond edges.
_EXTENT_DEVIATIONS = 1.5

# A patch whose second axis is shorter, voxels, has no plane: its hits lie on a line. It becomes a
# strip that faces the sensor, with this deviation across. Neighbors neither continue it nor are
# continued by it. A patch whose first axis is shorter is not drawn.
_LEAST_WIDTH = 3e-3

# A neighbor continues a surface where its plane passes this near, voxels: more leaves fewer holes
# around small things, and draws more that is not there. The surface must also head for it: at
# least this share of a step in its direction must lie in the plane.
_CONTINUES_VOXELS = 0.35
_HEADS_FOR = 0.45

# Corners on one edge of the grid become one, if they are this near, voxels, and if the cosine
# between their normals is at least this: creases stay sharp.
_JOINED_VOXELS = 0.15
_JOINED_COSINE = 0.7

_ON_GRID = 1e-6  # voxels


class Patches(NamedTuple):
    """The patches that queries use, in voxels from the corner of the grid.

    Attributes:
        center: Mean of the hits, (M, 3).
        normal: Unit vectors toward the sensor's side, (M, 3).
        direction: The directions in which the polygon ends, unit vectors, (D, M, 3).
        limit: Where it ends in each direction, from the center, (D, M).
        is_strip: The hits lie on a line, (M,) bool.
    """

    center: np.ndarray
    normal: np.ndarray
    direction: np.ndarray
    limit: np.ndarray
    is_strip: np.ndarray


class Polygons(NamedTuple):
    """Convex polygons of at most K corners.

    Attributes:
        corner: (M, K, 3), counterclockwise around the normal; only the first ones are meant.
        count: Number of corners, (M,).
    """

    corner: np.ndarray
    count: np.ndarray


class Triangles(NamedTuple):
    """Triangles with common vertices, in voxels from the corner of the grid.

    Attributes:
        vertex: (V, 3).
        normal: Unit vectors toward the sensor's side, (V, 3).
        face: Rows of vertices, counterclockwise around the normal, (F, 3).
        is_strip: The vertex belongs to a strip, (V,) bool.
    """

    vertex: np.ndarray
    normal: np.ndarray
    face: np.ndarray
    is_strip: np.ndarray


def triangulate(surface: Surface) -> Triangles:
    """Triangulates the patches of a surface."""
    patches = find_patches(surface)
    polygons = cut_polygons(patches)
    return join_corners(polygons, patches.normal, patches.is_strip)


def find_patches(surface: Surface) -> Patches:
    """Finds the patches that queries use, and where their polygons end."""
    nearest, mean, axes = (
        np.asarray(array) for array in (surface.derived.nearest, surface.mean, surface.axes)
    )
    known = np.argwhere(nearest[..., 0] != NO_FEATURE)
    used = np.zeros(nearest.shape[:3], bool)
    used[tuple((known + nearest[tuple(known.T)]).T)] = True
    used &= np.linalg.norm(axes[..., 0, :].astype(np.float32), axis=-1) > _LEAST_WIDTH
    index = np.argwhere(used)
    mean, axes = (array[used].astype(float) for array in (mean, axes))
    normal = unit(np.cross(axes[:, 0], axes[:, 1]))
    width = np.linalg.norm(axes[:, 1], axis=-1)
    is_strip = width <= _LEAST_WIDTH
    axes[:, 1] *= np.maximum(_LEAST_WIDTH / np.maximum(width, 1e-9), 1)[:, None]
    row = np.full(used.shape, -1)
    row[used] = np.where(is_strip, -1, np.arange(len(index)))

    # The faces of the voxel, and the borders of the surface, which may cross them.
    middle = unit(axes[:, 1])
    direction = [np.broadcast_to(side, normal.shape) for side in (*np.eye(3), *-np.eye(3))]
    direction = np.stack([*direction, middle, -middle])
    end = np.sum(0.5 * np.abs(direction) - mean * direction, axis=-1)
    reach = _EXTENT_DEVIATIONS * np.linalg.norm(
        np.einsum("mij,dmj->dmi", axes[:, :2], direction), axis=-1
    )
    limit = np.minimum(reach, end)
    for k, side in enumerate(direction):
        continues = ~is_strip & _continues(row, index, mean, normal, side)
        limit[k] = np.where(continues, end[k], limit[k])
    # Across its plane a polygon would be cut by its slope.
    each, steepest = np.arange(len(index)), np.argmax(np.abs(normal), axis=-1)
    for face in (steepest, steepest + 3):
        limit[face, each] = end[face, each]
    return Patches(index + 0.5 + mean, normal, direction, limit, is_strip)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scales vectors (..., 3) to length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _continues(
    row: np.ndarray, index: np.ndarray, mean: np.ndarray, normal: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Returns a mask of the patches whose surface the next voxel in a direction continues.

    Args:
        row: Row of each voxel's patch, -1 for none, (X, Y, Z).
        index: The patches' voxels, (M, 3).
        mean: Their centers relative to the voxels', (M, 3).
        normal: (M, 3).
        direction: Unit vectors, (M, 3).

    Returns:
        (M,) bool.
    """
    along = direction - normal * np.sum(normal * direction, axis=-1, keepdims=True)
    # The face of the voxel through which the surface leaves.
    steep = np.abs(along) > 1e-6
    lengths = (0.5 - np.sign(along) * mean) / np.where(steep, np.abs(along), 1e-6)
    face = np.argmin(np.where(steep, lengths, np.inf), axis=-1)
    each = np.arange(len(index))
    step = np.zeros(index.shape, int)
    step[each, face] = np.sign(along[each, face])
    beside = index + step
    inside = np.all((beside >= 0) & (beside < row.shape), axis=-1)
    other = np.where(inside, row[tuple(np.where(inside[:, None], beside, 0).T)], -1)
    # Seen from the other voxel's center.
    leaves = mean + along * lengths[each, face][:, None] - step
    height = np.sum((leaves - mean[other]) * normal[other], axis=-1)
    heads_for = np.linalg.norm(along, axis=-1) > _HEADS_FOR
    return (other >= 0) & heads_for & (np.abs(height) < _CONTINUES_VOXELS)


def cut_polygons(patches: Patches) -> Polygons:
    """Cuts the patches' planes in all their directions."""
    normal = patches.normal
    first = unit(np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=-1)]))
    second = np.cross(normal, first)
    # Larger than any cut of a voxel by a plane.
    square = [a * first + b * second for a, b in ((-2, -2), (2, -2), (2, 2), (-2, 2))]
    polygons = Polygons(np.stack(square, axis=1), np.full(len(normal), 4))
    for direction, limit in zip(patches.direction, patches.limit, strict=True):
        polygons = _clip(polygons, direction, limit)
    return polygons._replace(corner=polygons.corner + patches.center[:, None])


def _clip(polygons: Polygons, direction: np.ndarray, limit: np.ndarray) -> Polygons:
    """Keeps the parts of polygons on one side of planes (Sutherland and Hodgman, 1974).

    Args:
        polygons: M polygons of at most K corners.
        direction: The planes' normals, away from what is kept, (M, 3).
        limit: Their distance from the origin, (M,).

    Returns:
        M polygons of at most K + 1 corners, some with none.
    """
    corner, count = polygons
    rows, most, _ = corner.shape
    place = np.arange(most)
    valid = place < count[:, None]
    following = np.where(place + 1 < count[:, None], place + 1, 0)
    beyond = np.einsum("mkc,mc->mk", corner, direction) - limit[:, None]
    kept = valid & (beyond <= 0)
    beyond_next = np.take_along_axis(beyond, following, axis=1)
    crosses = valid & ((beyond <= 0) != (beyond_next <= 0))
    share = beyond / np.where(crosses, beyond - beyond_next, 1)
    following = np.take_along_axis(corner, following[..., None], axis=1)
    cut = corner + share[..., None] * (following - corner)
    # Each corner that is kept is followed by the cut of the edge after it.
    added = kept.astype(int) + crosses
    first = np.cumsum(added, axis=1) - added
    result = np.zeros((rows, most + 1, 3))
    row, old = np.nonzero(kept)
    result[row, first[row, old]] = corner[row, old]
    row, old = np.nonzero(crosses)
    result[row, first[row, old] + kept[row, old]] = cut[row, old]
    return Polygons(result, added.sum(axis=1))


def join_corners(polygons: Polygons, normal: np.ndarray, is_strip: np.ndarray) -> Triangles:
    """Triangulates polygons and joins the corners that they have on the edges of the grid.

    Args:
        polygons: M polygons.
        normal: Their normals, (M, 3).
        is_strip: Their corners stay alone, (M,) bool.

    Returns:
        The triangles, without those that the joining made empty or equal.
    """
    count = polygons.count
    row, place = np.nonzero(np.arange(polygons.corner.shape[1]) < count[:, None])
    corner, normal, is_strip = polygons.corner[row, place], normal[row], is_strip[row]
    vertex_of, vertex = _join(corner, normal, is_strip)
    # The sides of a sheet face away from each other.
    _, first = np.unique(vertex_of, return_index=True)
    sign = np.where(np.sum(normal * normal[first][vertex_of], axis=-1) < 0, -1.0, 1.0)
    total = _sum_of_rows(sign[:, None] * normal, vertex_of, len(vertex))
    total = unit(total)

    # A fan around the first corner of each polygon.
    start = np.repeat(np.cumsum(count) - count, count)
    row = np.nonzero((place > 0) & (place + 1 < count[row]))[0]
    face = vertex_of[np.stack([start[row], row, row + 1], axis=1)]
    full = (face[:, 0] != face[:, 1]) & (face[:, 1] != face[:, 2]) & (face[:, 2] != face[:, 0])
    face = face[full]
    _, some = np.unique(np.sort(face, axis=1), axis=0, return_index=True)
    return Triangles(vertex, total, face[np.sort(some)], is_strip[first])


def _join(
    corner: np.ndarray, normal: np.ndarray, is_strip: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Finds the corners that become one vertex.

    Args:
        corner: (N, 3) voxels.
        normal: (N, 3).
        is_strip: The corner stays alone, (N,) bool.

    Returns:
        The vertex of each corner, (N,), and the vertices, (V, 3).
    """
    nearest = np.round(corner)
    on_grid = np.abs(corner - nearest) < _ON_GRID
    # The edge of the grid that a corner lies on runs along the axis in which it is between voxels;
    # at a corner of the grid, along the normal.
    loose = np.where(on_grid, -1.0, 1.0) + 0.1 * np.abs(normal)
    axis = np.argmax(loose, axis=-1)
    on_edge = (on_grid.sum(axis=-1) >= 2) & ~is_strip
    others = (axis[:, None] + [1, 2]) % 3
    line = np.take_along_axis(nearest, others, axis=1)
    line = np.where(on_edge[:, None], line, [-1, -1])
    at = np.take_along_axis(corner, axis[:, None], axis=1)[:, 0]
    # Corners beside each other on one line come together; those on no edge stay alone.
    alone = np.where(on_edge, 0, 1 + np.arange(len(corner)))
    order = np.lexsort([at, alone, line[:, 1], line[:, 0], axis])
    key = np.column_stack([axis, line, alone])[order]
    apart = np.any(key[1:] != key[:-1], axis=1) | (np.diff(at[order]) > _JOINED_VOXELS)
    group = np.concatenate([[0], np.cumsum(apart)]) if len(order) else order
    # Corners of other surfaces through the same point form a second group, or stay alone.
    lead = np.searchsorted(group, group)
    cosine = np.abs(np.sum(normal[order] * normal[order][lead], axis=-1))
    other = cosine < _JOINED_COSINE
    vertex_of = np.empty(len(corner), int)
    vertex_of[order] = 2 * group + other
    _, vertex_of = np.unique(vertex_of, return_inverse=True)
    size = np.bincount(vertex_of)
    return vertex_of, _sum_of_rows(corner, vertex_of, len(size)) / size[:, None]


def _sum_of_rows(values: np.ndarray, row: np.ndarray, count: int) -> np.ndarray:
    """Sums values (N, 3) by the row that each belongs to; returns (count, 3)."""
    columns = [np.bincount(row, column, count).astype(float) for column in values.T]
    return np.stack(columns, axis=-1)
