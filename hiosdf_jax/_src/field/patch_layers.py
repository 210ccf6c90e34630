"""Joins patches that lie in layers: noise wider than a voxel leaves several before each other.

Each voxel fits a patch to its own hits. Where the noise of the sensor is a large part of a voxel,
the hits of one surface fall into several layers of voxels, and their patches are thick and tilted.
Here all of them move onto the plane through the patches around them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.field.patch_neighbors import dot, neighbors, steps
from hiosdf_jax._src.field.patch_rectangles import FILLING_VOXELS, Patches
from hiosdf_jax._src.grid.patches import EXTENT_DEVIATIONS
from hiosdf_jax._src.state.pytrees import NO_FEATURE

# Patches are joined where the root mean square of the thickness around them is larger than the
# first number, voxels. Hits that fill a voxel evenly have 0.29. Patches that are sharper than the
# second one count more: strays beside or inside a sharp wall are no noise. Sharp patches are joined
# if more than the third number of the area around them is.
_NOISY_VOXELS = 0.15
_SHARP_VOXELS = 0.1
_NOISY_SHARE = 0.4

# A patch's weight in a plane is its area times a Gaussian of its distance with this deviation,
# voxels, times the density of its hits. The logarithm of the density is limited to this.
_NEAR_VOXELS = 0.8
_MOST_GROWTH = 3.0

# The plane goes through patches up to this many voxels away: a layer on either side, twice.
_REACH = 2

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

# Each joined patch moves twice: the plane of neighbors that have moved is less tilted.
_ROUNDS = 2

# Pairs of patches that are handled at a time: one step has few, and all take much memory.
_LEAST_PAIRS = 200_000

# Points along each side of a patch that stand for it when voxels look for their nearest one.
_MARKS = 3

# No surface is this far from the voxels that know it, voxels.
_FARTHEST_MARK = 3.0


class Joined(NamedTuple):
    """Patches without layers.

    Attributes:
        patches: At most one in each voxel, M of them.
        moved: Those that were joined, (M,) bool.
        spread: Standard deviation of the hits along the normals, (M,) voxels. It may be larger than
            the thickness of the patches.
    """

    patches: Patches
    moved: np.ndarray
    spread: np.ndarray


def join(patches: Patches, shape: tuple[int, int, int]) -> Joined:
    """Moves patches that lie in layers onto one surface.

    Args:
        patches: At most one in each voxel.
        shape: Of the grid.

    Returns:
        The patches; those away from noise as they were.
    """
    area = np.prod(np.linalg.norm(patches.axes[:, :2], axis=-1), axis=-1)
    center, normal = patches.center.copy(), patches.normal
    rows = np.flatnonzero(_are_noisy(patches, area, normal, shape))
    for turn in range(_ROUNDS):
        plane = _planes(patches, area, center, normal, rows, shape)
        if turn == 0:
            rows, plane = rows[plane.is_flat], plane.part(plane.is_flat)
        center[rows] += plane.height[:, None] * plane.normal
        normal[rows] = plane.normal
    moved = np.zeros(len(area), bool)
    moved[rows] = True
    if not len(rows):
        return Joined(patches, moved, patches.thickness)
    height = dot(center - patches.center, normal)
    voxel = patches.voxel.copy()
    voxel[rows] = np.clip(np.floor(center[rows]).astype(int), 0, np.subtract(shape, 1))
    flat = np.asarray(np.ravel_multi_index(tuple(voxel.T), shape))
    met = np.isin(flat, flat[rows])
    merged = _merge(
        patches._replace(voxel=voxel, center=center).part(met),
        *(values[met] for values in (area, normal, height, moved, flat)),
    )
    others = patches.part(~met)
    both = zip(merged.patches, others, strict=True)
    return Joined(
        Patches(*(np.concatenate(parts) for parts in both)),
        np.concatenate([merged.moved, np.zeros(len(others.voxel), bool)]),
        np.concatenate([merged.spread, others.thickness]),
    )


def nearest_of(nearest: np.ndarray, patches: Patches, joined: Joined) -> np.ndarray:
    """Finds the nearest patch anew for voxels around those that moved.

    Args:
        nearest: Offsets to the nearest of `patches`, as in `Derived`, (X, Y, Z, 3) int8.
        patches: Before they were joined.
        joined: The same ones, joined.

    Returns:
        Offsets to the nearest joined patch.
    """
    from scipy.spatial import KDTree

    nearest, shape = np.array(nearest), nearest.shape[:3]
    if not joined.moved.any():
        return nearest
    after = joined.patches
    changed = np.zeros(shape, bool)
    changed[tuple(patches.voxel.T)] = True
    changed[tuple(after.voxel[~joined.moved].T)] = False
    changed[tuple(after.voxel[joined.moved].T)] = True
    region = _dilated(changed)
    near = after.part(_dilated(region)[tuple(after.voxel.T)])
    line = np.linspace(-0.8, 0.8, _MARKS)
    marks = [near.center + a * near.axes[:, 0] + b * near.axes[:, 1] for a in line for b in line]
    voxel = np.argwhere(region)
    distance, mark = KDTree(np.concatenate(marks)).query(
        voxel + 0.5, distance_upper_bound=_FARTHEST_MARK, workers=-1
    )
    known = np.isfinite(distance)
    nearest[region] = NO_FEATURE
    voxel = voxel[known]
    nearest[tuple(voxel.T)] = near.voxel[mark[known] % len(near.voxel)] - voxel
    return nearest


def spread_around(joined: Joined, shape: tuple[int, int, int], position: np.ndarray) -> np.ndarray:
    """Returns the largest spread of joined patches in the 27 voxels around positions.

    Args:
        joined: The patches.
        shape: Of the grid.
        position: (V, 3) voxels from the corner of the grid.

    Returns:
        (V,) voxels; 0 where no patch was joined.
    """
    from scipy.ndimage import maximum_filter

    if not joined.moved.any():
        return np.zeros(len(position), np.float32)
    spread = np.zeros(shape, np.float32)
    spread[tuple(joined.patches.voxel[joined.moved].T)] = joined.spread[joined.moved]
    voxel = np.clip(np.floor(position).astype(int), 0, np.subtract(shape, 1))
    return maximum_filter(spread, 3, mode="constant")[tuple(voxel.T)]


def _dilated(mask: np.ndarray) -> np.ndarray:
    """Adds the 26 voxels around each."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(mask, 3, mode="constant")


def _are_noisy(
    patches: Patches, area: np.ndarray, normal: np.ndarray, shape: tuple[int, int, int]
) -> np.ndarray:
    """Returns a mask of the patches in noise, (M,) bool."""
    pairs, directions = [], steps(1)
    for one, other in neighbors(patches.voxel, shape, directions[len(directions) // 2 :]):
        kept = dot(normal[one], normal[other]) > _LEAST_FACING
        one, other = one[kept], other[kept]
        pairs.append((one, other, _nearness(patches.center[other] - patches.center[one])))

    def mean_around(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        total, summed = weight.copy(), weight * values
        for one, other, nearness in pairs:
            for own, added in ((one, other), (other, one)):
                share = nearness * weight[added]
                total[own] += share
                summed[own] += share * values[added]
        return summed / np.maximum(total, 1e-12)

    square = patches.thickness**2
    noisy = mean_around(square, area / (square + _SHARP_VOXELS**2)) > _NOISY_VOXELS**2
    return noisy | (mean_around(noisy, area) > _NOISY_SHARE)


class _Planes(NamedTuple):
    """Planes through patches and those around them, of K patches.

    Attributes:
        normal: Unit vectors toward the sensor's side, (K, 3).
        height: Above the patches' centers, (K,) voxels.
        is_flat: Whether the patches around lie about a plane, (K,) bool.
    """

    normal: np.ndarray
    height: np.ndarray
    is_flat: np.ndarray

    def part(self, kept: np.ndarray) -> _Planes:
        """Returns the planes of a mask, (K,) bool."""
        return _Planes(*(values[kept] for values in self))


def _planes(
    patches: Patches,
    area: np.ndarray,
    center: np.ndarray,
    normal: np.ndarray,
    rows: np.ndarray,
    shape: tuple[int, int, int],
) -> _Planes:
    """Fits planes to the patches around the given rows, with their new centers and normals."""
    place = np.full(len(area), -1)
    place[rows] = np.arange(len(rows))
    deviations, shift = patches.deviations, patches.center - patches.voxel - 0.5
    moment = np.einsum("mki,mkj->mij", deviations, deviations)
    total, count, first = area[rows], np.ones(len(rows)), np.zeros((len(rows), 3))
    second, facing = total[:, None, None] * moment[rows], total[:, None] * normal[rows]
    for own, added in _batches(neighbors(patches.voxel, shape, steps(_REACH), rows)):
        same_side = dot(normal[own], normal[added]) > _LEAST_FACING
        own, added = own[same_side], added[same_side]
        offset = center[added] - center[own]
        # The mean of a voxel's hits lies on the side on which they are denser: a gradient g of the
        # logarithm of their density moves it by g / 12. The integral of g is the growth.
        step = patches.voxel[added] - patches.voxel[own]
        growth = 0.5 * dot(12 * (shift[own] + shift[added]), step)
        density = np.exp(np.clip(growth, -_MOST_GROWTH, _MOST_GROWTH))
        share = area[added] * _nearness(offset) * density
        beside = moment[added] + offset[:, :, None] * offset[:, None, :]

        def summed(values: np.ndarray, to: np.ndarray = place[own]) -> np.ndarray:
            return _sums(values, to, len(rows))

        total = total + summed(share)
        count += summed(np.ones_like(share))
        first += summed(share[:, None] * offset)
        second += summed(share[:, None, None] * beside)
        facing += summed(share[:, None] * normal[added])
    total = np.maximum(total, 1e-12)
    mean = first / total[:, None]
    spread = second / total[:, None, None] - mean[:, :, None] * mean[:, None, :]
    variance, direction = np.linalg.eigh(spread)
    found = direction[:, :, 0]
    found *= np.where(dot(facing, found) < 0, -1, 1)[:, None]
    is_flat = (variance[:, 0] < _MOST_ACROSS * variance[:, 1]) & (count >= _LEAST_PATCHES)
    is_flat &= dot(facing, found) > _LEAST_MEAN_FACING * total
    return _Planes(found, dot(mean, found), is_flat)


def _merge(
    patches: Patches,
    area: np.ndarray,
    normal: np.ndarray,
    height: np.ndarray,
    moved: np.ndarray,
    flat: np.ndarray,
) -> Joined:
    """Makes one patch of those in the same voxel.

    Args:
        patches: Where they have moved to.
        area: Their areas, (M,) voxels^2.
        normal: Of the planes that they lie on now, (M, 3).
        height: How far they have moved along it, (M,) voxels.
        moved: Which ones have moved, (M,) bool.
        flat: Numbers of their voxels, (M,).

    Returns:
        A patch for each voxel.
    """
    flat, first, group = np.unique(flat, return_index=True, return_inverse=True)
    center = patches.center
    # Patches that have not moved lead, then larger ones; those that disagree with the leader go.
    order = np.lexsort((-area, moved, group))
    leader = order[np.searchsorted(group[order], np.arange(len(flat)))]
    led = leader[group]
    agrees = dot(normal, normal[led]) > _LEAST_COSINE
    agrees &= np.abs(dot(center - center[led], normal[led])) < _FARTHEST_VOXELS
    weight = np.where(agrees, area, 0)
    weight /= np.maximum(np.bincount(group, weight), 1e-12)[group]

    def mean(values: np.ndarray) -> np.ndarray:
        factor = weight.reshape(-1, *[1] * (values.ndim - 1))
        return _sums(factor * values, group, len(flat))

    is_joined = np.bincount(group, moved & agrees) > 0
    middle, up = mean(center), mean(normal)
    up /= np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-12)
    deviations, offset = patches.deviations, center - middle[group]
    moment = np.einsum("mki,mkj->mij", deviations, deviations)
    moment = mean(moment + offset[:, :, None] * offset[:, None, :])
    across = np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", up, moment, up), 0))
    flatten = np.eye(3) - up[:, :, None] * up[:, None, :]
    variance, direction = np.linalg.eigh(flatten @ moment @ flatten)
    long, middling = np.sqrt(np.maximum(variance[:, [2, 1]], 0)).T
    along = direction[:, :, 2]
    thick = np.minimum(across, _MOST_THICKNESS)
    axes = EXTENT_DEVIATIONS * np.stack(
        [long[:, None] * along, middling[:, None] * np.cross(up, along), thick[:, None] * up],
        axis=1,
    )
    axes = np.where(is_joined[:, None, None], axes, patches.axes[leader])
    middle = np.where(is_joined[:, None], middle, patches.center[leader])
    spread = np.sqrt(across**2 + mean(height**2))
    spread = np.where(is_joined, spread, patches.thickness[leader])
    # Those of a noisy surface are not drawn one by one beside it.
    in_free_space = (np.bincount(group, patches.in_free_space) > 0) & ~is_joined
    return Joined(Patches(patches.voxel[first], middle, axes, in_free_space), is_joined, spread)


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


def _nearness(offset: np.ndarray) -> np.ndarray:
    """Computes a Gaussian of distances, from offsets (P, 3) voxels."""
    return np.exp(-0.5 * dot(offset, offset) / _NEAR_VOXELS**2)
