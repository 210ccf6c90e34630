"""Joins stacked patches: noise spreads the hits of one surface over several layers of voxels.

Each voxel fits a patch to its own hits, so the patches of a noisy surface are stacked, thick and
tilted. This module moves them onto the planes through the patches around them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.field.patch_neighbors import (
    HALF_OF_26,
    dot,
    gaussian,
    neighbors,
    offsets_within,
)
from hiosdf_jax._src.field.patch_rectangles import FILLING_VOXELS, Patches
from hiosdf_jax._src.grid.patches import EXTENT_DEVIATIONS

# Patches are noisy where the root mean square of the thickness around them is larger than this,
# voxels. Hits that fill a voxel evenly have 0.29.
_NOISY_VOXELS = 0.15

# Patches that are sharper than this, voxels, weigh more: strays beside a sharp wall are no noise.
_SHARP_VOXELS = 0.1

# Other patches are noisy, too, if more than this share of the area around them is.
_NOISY_SHARE = 0.4

# A patch's weight in a plane is its area times a Gaussian of its distance with this deviation,
# voxels, times the density of its hits. The logarithm of the density is limited to this.
_NEAR_VOXELS = 0.8
_MOST_GROWTH = 3.0

# The plane goes through patches in the voxels at these offsets; the weight of others is small.
_OFFSETS = [offset for offset in offsets_within(2) if np.dot(offset, offset) < 6]

# At least this many patches make a plane, and the variance across it is at most this share of the
# smaller one along it. Where surfaces meet there is no such plane.
_LEAST_PATCHES = 4
_MOST_ACROSS = 0.6

# Patches are on the same side of a solid if their normals have at least this cosine. Noise tilts
# them; a smaller one counts those that lie across in a wall.
_LEAST_FACING = 0.2

# The patches around must face the plane's side: the mean cosine is at least this.
_LEAST_MEAN_FACING = 0.5

# Patches that come to lie in one voxel become one if their normals have at least this cosine, and
# their planes are nearer than this, voxels.
_LEAST_COSINE = 0.8
_FARTHEST_VOXELS = 0.35

# Joined patches do not fill their voxel, however wide the noise is.
_MOST_THICKNESS = 0.75 * FILLING_VOXELS

# Offsets to neighbors are handled together until they have this many pairs of patches. One by one
# they are slow, and all at once they take much memory.
_LEAST_PAIRS = 200_000

# Patches move this often by the mean height of those around them.
_ROUNDS = 2

# Points along each side of a patch that stand for it when voxels look for their nearest one.
_MARKS = 3


class Joined(NamedTuple):
    """Patches after stacked ones were joined.

    Attributes:
        patches: At most one in each voxel, M of them.
        is_joined: Those made of one or more that moved, (M,) bool.
        spread: Standard deviation of the hits along the normals, (M,) voxels. It may be larger than
            the thickness of the patches.
    """

    patches: Patches
    is_joined: np.ndarray
    spread: np.ndarray


def join(patches: Patches, shape: tuple[int, int, int]) -> Joined:
    """Moves stacked patches onto one surface.

    Args:
        patches: At most one in each voxel.
        shape: Voxels of the grid along x, y and z.

    Returns:
        The patches, in another order. Those away from noise are unchanged.
    """
    normal, center = patches.normal, patches.center.copy()
    rows = np.flatnonzero(_are_noisy(patches, normal, shape))
    found, is_flat = _plane_normals(patches, normal, rows, shape)
    rows = rows[is_flat]
    normal[rows] = found[is_flat]
    for _ in range(_ROUNDS):
        height = _heights(patches, center, normal, rows, shape)
        center[rows] += height[:, None] * normal[rows]
    return _merge(patches, center, normal, rows, shape)


def nearest_of(nearest: np.ndarray, patches: Patches, joined: Joined) -> np.ndarray:
    """Finds the nearest patch anew for voxels around those that moved.

    Voxels more than two voxels away keep their offsets, even to patches that are gone: they are not
    among the eight voxels around any point of the surface.

    Args:
        nearest: Offsets to the nearest of `patches`, as in `Derived`, (X, Y, Z, 3) int8.
        patches: Before they were joined.
        joined: The same ones, joined.

    Returns:
        Offsets to the nearest joined patch.
    """
    from scipy.spatial import KDTree

    nearest, shape = np.array(nearest), nearest.shape[:3]
    if not joined.is_joined.any():
        return nearest
    after = joined.patches
    changed = np.zeros(shape, bool)
    changed[tuple(patches.voxel.T)] = True
    changed[tuple(after.voxel[~joined.is_joined].T)] = False
    changed[tuple(after.voxel[joined.is_joined].T)] = True
    region = _largest_around(changed, 2)
    near = after.part(_largest_around(region, 2)[tuple(after.voxel.T)])
    line = np.linspace(-0.8, 0.8, _MARKS)
    marks = [near.center + a * near.axes[:, 0] + b * near.axes[:, 1] for a in line for b in line]
    voxel = np.argwhere(region)
    _, mark = KDTree(np.concatenate(marks)).query(voxel + 0.5, workers=-1)
    nearest[region] = near.voxel[mark % len(near.voxel)] - voxel
    return nearest


def spread_around(joined: Joined, shape: tuple[int, int, int], position: np.ndarray) -> np.ndarray:
    """Returns the largest spread of joined patches in the 27 voxels around positions.

    Args:
        joined: The patches.
        shape: Voxels of the grid along x, y and z.
        position: (V, 3) voxels from the corner of the grid.

    Returns:
        (V,) voxels; 0 where no patch was joined.
    """
    if not joined.is_joined.any():
        return np.zeros(len(position), np.float32)
    spread = np.zeros(shape, np.float32)
    rows = joined.is_joined
    spread[tuple(joined.patches.voxel[rows].T)] = joined.spread[rows]
    voxel = np.clip(np.floor(position).astype(int), 0, np.subtract(shape, 1))
    return _largest_around(spread, 1)[tuple(voxel.T)]


def _largest_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Takes the largest value of the voxels up to `reach` away along each axis."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(values, 2 * reach + 1, mode="constant")


def _are_noisy(patches: Patches, normal: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Returns a mask of the patches in noise, (M,) bool."""
    pairs = []
    for one, other in neighbors(patches.voxel, shape, HALF_OF_26):
        kept = dot(normal[one], normal[other]) > _LEAST_FACING
        one, other = one[kept], other[kept]
        pairs.append(
            (one, other, gaussian(patches.center[other] - patches.center[one], _NEAR_VOXELS))
        )

    def mean_around(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        total, summed = weight.copy(), weight * values
        for one, other, nearness in pairs:
            for own, added in ((one, other), (other, one)):
                share = nearness * weight[added]
                total[own] += share
                summed[own] += share * values[added]
        return summed / np.maximum(total, 1e-12)

    area, square = patches.area, patches.thickness**2
    noisy = mean_around(square, area / (square + _SHARP_VOXELS**2)) > _NOISY_VOXELS**2
    return noisy | (mean_around(noisy, area) > _NOISY_SHARE)


def _plane_normals(
    patches: Patches,
    normal: np.ndarray,
    rows: np.ndarray,
    shape: tuple[int, int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Fits planes to the patches around K given ones.

    Returns:
        Their normals, unit vectors toward the sensor's side, (K, 3), and a mask of those around
        which the patches lie about a plane, (K,) bool.
    """
    size, moment = len(rows), patches.moment
    total, count, first = patches.area[rows], np.ones(size), np.zeros((size, 3))
    second, facing = total[:, None, None] * moment[rows], total[:, None] * normal[rows]
    for own, added, to, share in _weighted(patches, patches.center, normal, rows, shape):
        offset = patches.center[added] - patches.center[own]
        beside = moment[added] + offset[:, :, None] * offset[:, None, :]
        total = total + _sums(share, to, size)
        count += _sums(np.ones_like(share), to, size)
        first += _sums(share[:, None] * offset, to, size)
        second += _sums(share[:, None, None] * beside, to, size)
        facing += _sums(share[:, None] * normal[added], to, size)
    total = np.maximum(total, 1e-12)
    mean = first / total[:, None]
    spread = second / total[:, None, None] - mean[:, :, None] * mean[:, None, :]
    variance, direction = np.linalg.eigh(spread)
    found = direction[:, :, 0]
    found *= np.where(dot(facing, found) < 0, -1, 1)[:, None]
    is_flat = (variance[:, 0] < _MOST_ACROSS * variance[:, 1]) & (count >= _LEAST_PATCHES)
    is_flat &= dot(facing, found) > _LEAST_MEAN_FACING * total
    return found, is_flat


def _heights(
    patches: Patches,
    center: np.ndarray,
    normal: np.ndarray,
    rows: np.ndarray,
    shape: tuple[int, int, int],
) -> np.ndarray:
    """Computes the mean height of the patches around K given ones, (K,) voxels.

    A height is the mean of that above the one patch's plane and that below the other one's: on a
    sphere it is 0.
    """
    total, summed = patches.area[rows], np.zeros(len(rows))
    for own, added, to, share in _weighted(patches, center, normal, rows, shape):
        between = 0.5 * (normal[own] + normal[added])
        height = dot(center[added] - center[own], between)
        total = total + _sums(share, to, len(rows))
        summed += _sums(share * height, to, len(rows))
    return summed / np.maximum(total, 1e-12)


def _weighted(
    patches: Patches,
    center: np.ndarray,
    normal: np.ndarray,
    rows: np.ndarray,
    shape: tuple[int, int, int],
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yields given rows, those of patches around them on the same side, and their weights.

    Yields:
        For P pairs, in batches: the rows of both, the places of the first ones in `rows`, and the
        weights of the second ones, (P,) each.
    """
    area, place = patches.area, np.full(len(patches.voxel), -1)
    place[rows] = np.arange(len(rows))
    shift = patches.center - patches.voxel - 0.5
    for own, added in _batches(neighbors(patches.voxel, shape, _OFFSETS, rows)):
        same_side = dot(normal[own], normal[added]) > _LEAST_FACING
        own, added = own[same_side], added[same_side]
        # The mean of a voxel's hits lies on the side on which they are denser: a gradient g of the
        # logarithm of their density moves it by g / 12. The integral of g is the growth.
        step = patches.voxel[added] - patches.voxel[own]
        growth = 0.5 * dot(12 * (shift[own] + shift[added]), step)
        density = np.exp(np.clip(growth, -_MOST_GROWTH, _MOST_GROWTH))
        share = area[added] * gaussian(center[added] - center[own], _NEAR_VOXELS) * density
        yield own, added, place[own], share


def _merge(
    patches: Patches,
    center: np.ndarray,
    normal: np.ndarray,
    rows: np.ndarray,
    shape: tuple[int, int, int],
) -> Joined:
    """Makes one patch of those that have come to lie in the same voxel.

    Args:
        patches: Before the given ones moved.
        center: Where they have moved to, (M, 3) voxels.
        normal: Of the planes that they lie on now, (M, 3).
        rows: Of those that have moved, (K,).
        shape: Voxels of the grid along x, y and z.

    Returns:
        At most one patch for each voxel.
    """
    voxel = patches.voxel.copy()
    voxel[rows] = np.clip(np.floor(center[rows]).astype(int), 0, np.subtract(shape, 1))
    area, moved = patches.area, np.zeros(len(patches.voxel), bool)
    moved[rows] = True
    while True:
        flat = np.asarray(np.ravel_multi_index(tuple(voxel.T), shape))
        met = np.flatnonzero(np.isin(flat, flat[moved]))
        group = np.unique(flat[met], return_inverse=True)[1]
        # Patches that have not moved lead, then larger ones.
        order = np.lexsort((-area[met], moved[met], group))
        leader = met[order[np.searchsorted(group[order], np.arange(np.max(group, initial=-1) + 1))]]
        led = leader[group]
        agrees = dot(normal[met], normal[led]) > _LEAST_COSINE
        agrees &= np.abs(dot(center[met] - center[led], normal[led])) < _FARTHEST_VOXELS
        back = met[~agrees & (met != led)]
        if not len(back):
            break
        # Those that disagree with the leader return: they may be another side of a thin wall.
        moved[back] = False
        voxel[back], center[back] = patches.voxel[back], patches.center[back]
        normal[back] = patches.normal[back]
    if not len(met):
        return Joined(patches, moved, patches.thickness)
    kept = np.setdiff1d(np.arange(len(area)), met)
    height = dot(center - patches.center, normal)[met]
    moved_to = patches._replace(voxel=voxel, center=center).part(met)
    merged, spread = _means(moved_to, normal[met], height, group)
    return Joined(
        Patches(*map(np.concatenate, zip(merged, patches.part(kept), strict=True))),
        np.repeat([True, False], [len(spread), len(kept)]),
        np.concatenate([spread, patches.thickness[kept]]),
    )


def _means(
    patches: Patches, normal: np.ndarray, height: np.ndarray, group: np.ndarray
) -> tuple[Patches, np.ndarray]:
    """Averages patches in the same voxel, by area.

    Args:
        patches: Where they have moved to.
        normal: Of the planes that they lie on, (M, 3).
        height: How far they have moved along it, (M,) voxels.
        group: Numbers of their voxels, 0 to N - 1, (M,).

    Returns:
        N patches, and the standard deviations of their hits along the normals before they moved,
        (N,) voxels.
    """
    _, first = np.unique(group, return_index=True)
    area = np.maximum(patches.area, 1e-12)
    weight = area / np.bincount(group, area)[group]

    def mean(values: np.ndarray) -> np.ndarray:
        factor = weight.reshape(-1, *[1] * (values.ndim - 1))
        return _sums(factor * values, group, len(first))

    middle, up = mean(patches.center), mean(normal)
    up /= np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-12)
    offset = patches.center - middle[group]
    moment = mean(patches.moment + offset[:, :, None] * offset[:, None, :])
    across = np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", up, moment, up), 0))
    flatten = np.eye(3) - up[:, :, None] * up[:, None, :]
    variance, direction = np.linalg.eigh(flatten @ moment @ flatten)
    long, middling = np.sqrt(np.maximum(variance[:, [2, 1]], 0)).T
    along, thick = direction[:, :, 2], np.minimum(across, _MOST_THICKNESS)
    axes = [long[:, None] * along, middling[:, None] * np.cross(up, along), thick[:, None] * up]
    # Those of a noisy surface are not drawn one by one beside it.
    in_free_space = np.zeros(len(first), bool)
    joined = Patches(
        patches.voxel[first], middle, EXTENT_DEVIATIONS * np.stack(axes, axis=1), in_free_space
    )
    return joined, np.sqrt(across**2 + mean(height**2))


def _batches(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Iterator[list[np.ndarray]]:
    """Joins pairs of arrays into fewer, longer ones."""
    waiting, count = [], 0
    for pair in pairs:
        waiting.append(pair)
        count += len(pair[0])
        if count > _LEAST_PAIRS:
            yield [np.concatenate(parts) for parts in zip(*waiting, strict=True)]
            waiting, count = [], 0
    if waiting:
        yield [np.concatenate(parts) for parts in zip(*waiting, strict=True)]


def _sums(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Adds up the rows of values (P, ...) by group (P,): (count, ...)."""
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = [np.bincount(group, column, count) for column in columns]
    return np.stack(sums, axis=-1).reshape(count, *values.shape[1:])
