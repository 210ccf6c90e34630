"""Smooths the patches of a grid: each takes the plane through it and those that continue it.

The normal of a single voxel's hits follows their noise, and tilts where they straddle a face of
voxels. A plane through the means of neighbors, which lie a voxel apart, hardly tilts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.field.patch_neighbors import HALF_OF_26, dot, gaussian, neighbors
from hiosdf_jax._src.field.patch_rectangles import Patches

# A patch continues another one's plane if their normals have at least this cosine, and the center
# of each is nearer to the other one's plane than the distance, voxels. On the same side of a wall,
# whose noise may fill two layers of voxels, the standard deviations of both along their normals are
# added. No smoothed normal turns by more either.
_LEAST_COSINE = 0.9
_FARTHEST_VOXELS = 0.2

# A patch's weight is its area times a Gaussian of its distance with this deviation, voxels.
_NEAR_VOXELS = 0.6

# Patches with a shorter edge, half of it in voxels, stay as they are: hits on a line have no plane.
_LEAST_SMOOTHED = 0.1


def smooth(patches: Patches, shape: tuple[int, int, int]) -> Patches:
    """Moves patches onto planes through the patches around them.

    The plane of a patch is the principal one of the hits of up to 27 patches that continue it.

    Args:
        patches: At most one in each voxel.
        shape: Of the grid.

    Returns:
        The patches in the same order, of the same sizes.
    """
    wide = np.linalg.norm(patches.axes[:, 1], axis=-1) > _LEAST_SMOOTHED
    center, axes = patches.center.copy(), patches.axes.copy()
    center[wide], axes[wide] = _smooth(patches.part(wide), shape)
    return patches._replace(center=center, axes=axes)


def _smooth(patches: Patches, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the centers and axes of smoothed patches."""
    normal = patches.normal
    area = patches.area
    pairs = _find_pairs(patches, normal, shape)
    normal = _plane_normals(patches, normal, area, pairs)
    # The mean height of a neighbor above the patch's plane, and of the patch above the neighbor's.
    # On a sphere it is 0.
    total, height = area.copy(), np.zeros_like(area)
    for pair in pairs:
        for own, added, offset in pair.directions():
            share = area[added] * pair.nearness
            side = np.where(dot(normal[own], normal[added]) < 0, -1, 1)
            between = 0.5 * (normal[own] + side[:, None] * normal[added])
            total[own] += share
            height[own] += share * dot(offset, between)
    center = patches.center + (height / total)[:, None] * normal
    return center, _turned(patches.axes, normal)


class _Pairs(NamedTuple):
    """Patches that continue each other, in one direction of the 13 to half of the neighbors.

    Attributes:
        one: Rows of the first patches, each at most once, (P,).
        other: Rows of the second ones, (P,).
        offset: From the first centers to the second ones, (P, 3) voxels.
        nearness: Factor of the weight, (P,).
    """

    one: np.ndarray
    other: np.ndarray
    offset: np.ndarray
    nearness: np.ndarray

    def directions(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yields rows, those of their neighbors, and the offsets, there and back."""
        yield self.one, self.other, self.offset
        yield self.other, self.one, -self.offset


def _find_pairs(patches: Patches, normal: np.ndarray, shape: tuple[int, int, int]) -> list[_Pairs]:
    """Finds the patches in neighboring voxels that continue each other."""
    thickness, pairs = patches.thickness, []
    for one, other in neighbors(patches.voxel, shape, HALF_OF_26):
        offset = patches.center[other] - patches.center[one]
        height = [dot(offset, normal[row]) for row in (one, other)]
        cosine = dot(normal[one], normal[other])
        farthest = _FARTHEST_VOXELS + np.where(cosine > 0, thickness[one] + thickness[other], 0)
        kept = (np.max(np.abs(height), axis=0) < farthest) & (np.abs(cosine) > _LEAST_COSINE)
        offset = offset[kept]
        pairs.append(_Pairs(one[kept], other[kept], offset, gaussian(offset, _NEAR_VOXELS)))
    return pairs


def _plane_normals(
    patches: Patches, normal: np.ndarray, area: np.ndarray, pairs: list[_Pairs]
) -> np.ndarray:
    """Computes the normals of planes through patches and those that continue them, (M, 3)."""
    moment = patches.moment
    total, first, second = area.copy(), np.zeros_like(normal), area[:, None, None] * moment
    for pair in pairs:
        beside = pair.offset[:, :, None] * pair.offset[:, None, :]
        for own, added, offset in pair.directions():
            share = area[added] * pair.nearness
            total[own] += share
            first[own] += share[:, None] * offset
            second[own] += share[:, None, None] * (moment[added] + beside)
    mean = first / total[:, None]
    spread = second / total[:, None, None] - mean[:, :, None] * mean[:, None, :]
    found = np.linalg.eigh(spread)[1][:, :, 0]
    cosine = dot(found, normal)
    found *= np.where(cosine < 0, -1, 1)[:, None]
    # The principal plane of a column of narrow patches may lie across them.
    return np.where(np.abs(cosine)[:, None] > _LEAST_COSINE, found, normal)


def _turned(axes: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Turns axes (M, 3, 3) until the first two are perpendicular to a normal (M, 3)."""
    size = np.linalg.norm(axes, axis=-1, keepdims=True)
    along = axes[:, 0] - dot(axes[:, 0], normal)[:, None] * normal
    along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    return size * np.stack([along, np.cross(normal, along), normal], axis=1)
