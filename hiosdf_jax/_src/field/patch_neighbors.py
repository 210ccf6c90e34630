"""Finds the patches in the voxels around others."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

Step = tuple[int, ...]


def steps(reach: int) -> list[Step]:
    """Lists the steps to all voxels around one; the second half is the first one in reverse.

    Args:
        reach: The largest step along each axis, voxels.

    Returns:
        All steps but (0, 0, 0), in lexical order.
    """
    every = itertools.product(range(-reach, reach + 1), repeat=3)
    return [step for step in every if any(step)]


def neighbors(
    voxel: np.ndarray,
    shape: tuple[int, int, int],
    steps: Sequence[Step],
    rows: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields rows of voxels and those of their neighbors, for each step.

    Args:
        voxel: Indices, each voxel at most once, (M, 3) int.
        shape: Of the grid.
        steps: From voxels to their neighbors.
        rows: Of the voxels whose neighbors are asked for, (K,); all if left out.

    Yields:
        The rows that have a neighbor, and its rows, (P,) each.
    """
    pad = int(np.max(np.abs(steps)))
    padded = np.add(shape, 2 * pad)
    table = np.full(padded.prod(), -1, np.int32)
    flat = np.asarray(np.ravel_multi_index(tuple((voxel + pad).T), padded))
    table[flat] = np.arange(len(voxel))
    rows = np.arange(len(voxel)) if rows is None else rows
    flat = flat[rows]
    stride = np.array([padded[1] * padded[2], padded[2], 1])
    for along in np.reshape(steps, (-1, 3)) @ stride:
        beside = table[flat + along]
        found = np.flatnonzero(beside >= 0)
        yield rows[found], beside[found]


def dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Computes the scalar products of vectors (M, 3)."""
    return np.einsum("ij,ij->i", one, other)
