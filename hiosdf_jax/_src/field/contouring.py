"""Triangles of a zero level near the patches of a map, by dual contouring on a lattice.

Each cell that the level passes through gets a vertex: the mean of the points where the level
crosses the cell's edges (Gibson, Constrained Elastic Surface Nets, 1998). Each edge that it crosses
gets a quadrilateral between the four cells around it. The level may change its sign within a
sheet, as long as both ends of an edge can be compared.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.field.implicit_surface import OPPOSITE_COSINE, SAME_SHEET_VOXELS, Level

# The function at lattice points (N, 3), voxels from the corner of the grid.
type Function = Callable[[np.ndarray], Level]

CELLS_PER_VOXEL = 2
"""Cells of the lattice along the edge of a voxel."""

PADDING = 2
"""Points of the lattice beyond each face of the grid."""

# Steps by which the end of the surface is found between two vertices.
_BISECTIONS = 4


class _Crossings(NamedTuple):
    """Edges of the lattice that the level crosses.

    Attributes:
        cell: Flat indices of the four cells around the edge, counterclockwise seen from the
            positive side, (E, 4).
        position: Where the level crosses, (E, 3) voxels.
        beyond: As in `Level`, (E,).
    """

    cell: np.ndarray
    position: np.ndarray
    beyond: np.ndarray


def contour(near: np.ndarray, function: Function) -> tuple[np.ndarray, np.ndarray]:
    """Triangulates the zero level of a function.

    Args:
        near: The lattice points at which it is evaluated, bool: those of the grid's voxels and
            `PADDING` more on each side. The outermost ones are False.
        function: Its level is triangulated where `beyond` is negative.

    Returns:
        Vertices (V, 3), voxels from the grid's corner, and triangles: rows of vertices,
        counterclockwise seen from the positive side, (F, 3).
    """
    number = np.flatnonzero(near)
    position = (np.stack(np.unravel_index(number, near.shape), axis=-1) - PADDING) / CELLS_PER_VOXEL
    level = function(position)
    strides = near.shape[1] * near.shape[2], near.shape[2], 1
    edges = [_find_crossings(number, strides, position, level, axis) for axis in range(3)]
    vertex, face, beyond = _triangulate(_Crossings(*map(np.concatenate, zip(*edges, strict=True))))
    return _cut(vertex, face, beyond, function)


def _find_crossings(
    number: np.ndarray,
    strides: tuple[int, int, int],
    position: np.ndarray,
    level: Level,
    axis: int,
) -> _Crossings:
    """Finds where the level crosses the edges along an axis.

    Args:
        number: Flat indices of lattice points, ascending, (N,).
        strides: What a step along each axis adds to them.
        position: Their positions, (N, 3) voxels.
        level: The level there.
        axis: 0, 1 or 2.
    """
    # No point lies at the end of an axis, where a step would lead to its beginning.
    after = number + strides[axis]
    second = np.searchsorted(number[:-1], after)
    first = np.flatnonzero(number[second] == after)
    second = second[first]
    normal = level.plane_normal
    opposite = np.einsum("ij,ij->i", normal[first], normal[second]) < OPPOSITE_COSINE
    lifted = level.plane_height[first] + normal[first, axis] / CELLS_PER_VOXEL
    same_sheet = np.abs(lifted + level.plane_height[second]) < SAME_SHEET_VOXELS
    sign = np.where(opposite & same_sheet, -1, 1)
    low, high = level.height[first], sign * level.height[second]
    crossed = (low > 0) != (high > 0)
    first, second, low, high = (values[crossed] for values in (first, second, low, high))
    share = low / (low - high)
    beyond = level.beyond[first] + share * (level.beyond[second] - level.beyond[first])
    one, other = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
    cell = number[first][:, None] - [one + other, other, 0, one]
    cell = np.where((low > 0)[:, None], cell[:, ::-1], cell)
    crossing = position[first]
    crossing[:, axis] += share / CELLS_PER_VOXEL
    return _Crossings(cell, crossing, beyond)


def _triangulate(crossings: _Crossings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joins the crossings of each cell to a vertex, and the cells around each edge to triangles.

    Returns:
        Vertices (V, 3), triangles (F, 3), and how far the vertices lie beyond the surface, (V,).
    """
    cell, vertex_of = np.unique(crossings.cell, return_inverse=True)
    vertex_of = vertex_of.reshape(-1, 4)
    values = np.column_stack([crossings.position, crossings.beyond])
    total = [np.bincount(vertex_of.ravel(), np.repeat(v, 4), len(cell)) for v in values.T]
    mean = np.stack(total, axis=-1) / np.bincount(vertex_of.ravel(), minlength=len(cell))[:, None]
    face = np.concatenate([vertex_of[:, [0, 1, 2]], vertex_of[:, [0, 2, 3]]])
    return mean[:, :3], face, mean[:, 3]


def _cut(
    vertex: np.ndarray, face: np.ndarray, beyond: np.ndarray, function: Function
) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the parts of triangles that are not beyond the surface.

    Args:
        vertex: (V, 3).
        face: Rows of vertices, (F, 3).
        beyond: How far the vertices lie beyond the surface, (V,).
        function: Says the same of the points between them.

    Returns:
        Vertices and triangles.
    """
    kept = beyond < 0
    count = kept[face].sum(axis=1)

    def with_one_apart(corners: int) -> np.ndarray:
        """Returns the triangles with 1 or 2 kept corners, the only one of its kind first."""
        some = face[count == corners]
        apart = np.argmax(kept[some] == (corners == 1), axis=1)
        return np.take_along_axis(some, (apart[:, None] + [0, 1, 2]) % 3, axis=1)

    tip, stump = with_one_apart(1), with_one_apart(2)
    # Each edge that is cut gets one new vertex, also where two triangles meet.
    ends = np.concatenate([part[:, pair] for part in (tip, stump) for pair in ([0, 1], [0, 2])])
    ends = np.sort(ends, axis=1)
    edge, place = np.unique(ends[:, 0] * len(vertex) + ends[:, 1], return_inverse=True)
    low, high = np.divmod(edge, max(len(vertex), 1))
    inside = np.where(kept[low], low, high)
    inner, outer = vertex[inside], vertex[low + high - inside]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inner + outer)
        is_inner = (function(middle).beyond < 0)[:, None]
        inner, outer = np.where(is_inner, middle, inner), np.where(is_inner, outer, middle)
    vertex = np.concatenate([vertex, 0.5 * (inner + outer)])
    new = len(beyond) + place.ravel()
    ab, ac, de, df = np.split(new, np.cumsum([len(tip), len(tip), len(stump)]))
    _, e, f = stump.T
    face = np.concatenate(
        [
            face[count == 3],
            np.stack([tip[:, 0], ab, ac], axis=-1),
            np.stack([de, e, f], axis=-1),
            np.stack([de, f, df], axis=-1),
        ]
    )
    used = np.zeros(len(vertex), bool)
    used[face] = True
    return vertex[used], (np.cumsum(used) - 1)[face]
