"""Finds the patches in the voxels around others, and weighs them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

Offset = tuple[int, ...]


def offsets_within(reach: int) -> list[Offset]:
    """Lists the offsets to all voxels around one.

    Args:
        reach: The largest offset along each axis, voxels.

    Returns:
        All offsets but (0, 0, 0), in lexical order.
    """
    every = itertools.product(range(-reach, reach + 1), repeat=3)
    return [offset for offset in every if any(offset)]


HALF_OF_26 = offsets_within(1)[13:]
"""Offsets to 13 of the 26 voxels around one: each pair of neighbors once."""


def neighbors(
    voxel: np.ndarray,
    shape: tuple[int, int, int],
    offsets: Sequence[Offset],
    rows: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields rows of voxels and those of their neighbors, for each offset.

    Args:
        voxel: Indices, each voxel at most once, (M, 3) int.
        shape: Voxels of the grid along x, y and z.
        offsets: From voxels to their neighbors.
        rows: Of the voxels whose neighbors are asked for, (K,); all if left out.

    Yields:
        The rows that have a neighbor, and its rows, (P,) each.
    """
    pad = int(np.max(np.abs(offsets)))
    padded = np.add(shape, 2 * pad)
    table = np.full(padded.prod(), -1, np.int32)
    flat = np.asarray(np.ravel_multi_index(tuple((voxel + pad).T), padded))
    table[flat] = np.arange(len(voxel))
    rows = np.arange(len(voxel)) if rows is None else rows
    flat = flat[rows]
    stride = np.array([padded[1] * padded[2], padded[2], 1])
    for along in np.reshape(offsets, (-1, 3)) @ stride:
        beside = table[flat + along]
        found = np.flatnonzero(beside >= 0)
        yield rows[found], beside[found]


def dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Computes the scalar products of vectors (M, 3)."""
    return np.einsum("ij,ij->i", one, other)


def gaussian(offset: np.ndarray, deviation: float) -> np.ndarray:
    """Computes exp(-d^2 / (2 deviation^2)) of the lengths d of offsets (M, 3), voxels."""
    return np.exp(-0.5 * dot(offset, offset) / deviation**2)
