"""The evidence of a grid in another frame: patches move as they are, free space only shrinks.

A patch goes to the voxel that contains its moved mean. Patches that meet in a voxel add by their
moments. A voxel is seen, or free, only as far as all voxels are that it overlaps: a voxel that lies
across others at an angle must not be free because its center is.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow, fade_evidence
from hiosdf_jax._src.numerics.masks import where_leading
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.vectors import Vector, each, join, length, split
from hiosdf_jax._src.state.pytrees import Evidence

# A patch stays in its voxel if rounding has put its mean on the border: offsets count this much.
_INNER = 0.999

# Voxels overlap if they do so by more than this, voxels. Rounding must not make neighbors overlap.
_OVERLAP_VOXELS = 0.01

# A pose moves voxels onto voxels up to this error, voxels.
_ROUNDING = 1e-3

# A voxel that is observed by hits alone counts this many passes: it is seen, and not free.
_SEEN = 2.0**-8

# Patches that are surely surface, that may be, and those that most rays pass through.
_SURFACE, _DOUBTFUL, _STRAY, _NO_PATCH = 3, 2, 1, 0


def rebin(source: Config, evidence: Evidence, target: Config, pose: jax.Array) -> EvidenceWindow:
    """Expresses the evidence of a grid in another frame.

    Args:
        source: The configuration of the grid.
        evidence: Its evidence.
        target: The configuration of the new grid, with the same voxel size.
        pose: (4, 4) T_target_source, its rotation exact to rounding.

    Returns:
        The evidence as a window over the whole new grid, not rounded. What falls outside is lost.
    """
    shape = target.grid_shape
    moved, level = _move_patches(source, evidence, target, pose)
    free = _move_free_space(source, evidence, target, pose)
    has_patch = level > _NO_PATCH

    def choose(patch: jax.Array, other: jax.Array | float) -> jax.Array:
        return jnp.where(has_patch, patch, other).reshape(shape)

    def choose_vectors(values: jax.Array) -> jax.Array:
        return where_leading(has_patch, values, 0).reshape(*shape, *values.shape[1:])

    window = EvidenceWindow(
        start=moved.start,
        hits=choose(moved.hits, 0),
        passes=choose(moved.passes, free.passes),
        behind=choose(moved.behind, free.behind),
        weight=choose(moved.weight, 0),
        mean=choose_vectors(moved.mean),
        axes=choose_vectors(moved.axes),
        change=choose(moved.change, free.change).astype(jnp.int8),
    )
    surface = (level == _SURFACE).reshape(shape)
    return patches.keep_surfaces(target, fade_evidence(target, window), surface)


def coincides(target: Config, pose: jax.Array) -> jax.Array:
    """Returns whether a pose moves voxels onto voxels, () bool.

    Args:
        target: The configuration of the new grid.
        pose: (4, 4) T_target_source, its rotation exact to rounding.
    """
    shift = pose[:3, 3] / target.voxel_size
    turned = jnp.abs(pose[:3, :3] - jnp.round(pose[:3, :3]))
    shifted = jnp.abs(shift - jnp.round(shift))
    return (jnp.max(turned) < _ROUNDING) & (jnp.max(shifted) < _ROUNDING)


def passes_at(
    source: Config, evidence: Evidence, target: Config, pose: jax.Array, offset: jax.Array
) -> jax.Array:
    """Looks up how many rays passed points of the new grid.

    Args:
        source: The configuration of the grid.
        evidence: Its evidence.
        target: The configuration of the new grid.
        pose: (4, 4) T_target_source, its rotation exact to rounding.
        offset: A point in each voxel of the new grid, from the voxel's center, (X, Y, Z, 3) voxels.

    Returns:
        The passes of the voxels of the grid that contain the points, (X, Y, Z); 0 outside of it.
    """
    shape = target.grid_shape
    row = jnp.arange(shape[0] * shape[1] * shape[2], dtype=jnp.int32)
    point = each(
        jnp.add,
        _center(target, geometry.unflatten(shape, row)),
        split(offset.reshape(-1, 3).astype(jnp.float32)),
    )
    shift = split(pose[:3, 3] / target.voxel_size)
    point = _rotated(pose[:3, :3].T, each(jnp.subtract, point, shift))
    index, inside = _index_of(source, each(jnp.floor, point))
    passes = jnp.abs(evidence.passes.ravel().astype(jnp.float32))
    found = passes[geometry.flat_index(source.grid_shape, index)]
    return jnp.where(inside, found, 0).reshape(shape)


class _FreeSpace(NamedTuple):
    """The evidence of the new voxels without a patch, raveled; parts as in `EvidenceWindow`."""

    passes: jax.Array
    behind: jax.Array
    change: jax.Array


def count_lost(
    source: Config, evidence: Evidence, target: Config, pose: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Counts the surface patches that `rebin` loses, as they fall outside of the new grid.

    Args:
        source: The configuration of the grid.
        evidence: Its evidence.
        target: The configuration of the new grid, with the same voxel size.
        pose: (4, 4) T_target_source.

    Returns:
        Patches that are lost, and all patches, () int32 each.
    """
    _, _, cell = _move_means(source, evidence, target, pose)
    _, inside = _index_of(target, cell)
    hits, passes, root_weight = (
        array.ravel().astype(jnp.float32)
        for array in (evidence.hits, evidence.passes, evidence.root_weight)
    )
    axes = evidence.axes.reshape(-1, 3, 3)
    is_surface = patches.is_feature(source, hits, passes, root_weight**2, axes)
    return jnp.sum(is_surface & ~inside), jnp.sum(is_surface)


def _move_means(
    source: Config, evidence: Evidence, target: Config, pose: jax.Array
) -> tuple[Vector, Vector, Vector]:
    """Moves voxels with their patches.

    The centers and the offsets are apart, so that no digits are lost.

    Returns:
        The centers of the voxels, the means of the patches relative to them, and the cells in which
        the means lie, (V,) each, in voxels of the new frame.
    """
    rotation, shift = pose[:3, :3], split(pose[:3, 3] / target.voxel_size)
    row = jnp.arange(evidence.hits.size, dtype=jnp.int32)
    center = _center(source, geometry.unflatten(source.grid_shape, row))
    center = each(jnp.add, _rotated(rotation, center), shift)
    offset = _rotated(rotation, split(evidence.mean.reshape(-1, 3).astype(jnp.float32)))
    return center, offset, each(lambda c, o: jnp.floor(c + _INNER * o), center, offset)


def _move_patches(
    source: Config, evidence: Evidence, target: Config, pose: jax.Array
) -> tuple[EvidenceWindow, jax.Array]:
    """Moves the patches, and adds up those that meet in a voxel.

    Only the surest patches of a voxel count: stray hits must not carve a surface that they meet.
    Stray hits that meet do not become a surface either.

    Returns:
        The evidence of each voxel with a patch, raveled, and how sure the patch is, (V,) int32.
    """
    rotation = pose[:3, :3]
    count, shape = evidence.hits.size, target.grid_shape
    voxels = shape[0] * shape[1] * shape[2]
    hits, passes, behind, root_weight = (
        array.ravel().astype(jnp.float32)
        for array in (evidence.hits, evidence.passes, evidence.behind, evidence.root_weight)
    )
    change = evidence.change.ravel().astype(jnp.int32)
    axes = evidence.axes.reshape(-1, 3, 3)
    row = jnp.arange(count, dtype=jnp.int32)
    center, offset, cell = _move_means(source, evidence, target, pose)
    offset = each(lambda c, k, o: (c - k - 0.5) + o, center, cell, offset)
    index, inside = _index_of(target, cell)
    voxel = jnp.where(inside, geometry.flat_index(shape, index), voxels)

    level = (hits > 0).astype(jnp.int32)
    level = jnp.where(patches.is_doubtful(hits, passes), _DOUBTFUL, level)
    level = jnp.where(
        patches.is_feature(target, hits, passes, root_weight**2, axes), _SURFACE, level
    )
    surest = jnp.zeros(voxels, jnp.int32).at[voxel].max(level, mode="drop")
    counts = inside & (level > _NO_PATCH) & (level == surest[jnp.minimum(voxel, voxels - 1)])
    voxel = jnp.where(counts, voxel, voxels)

    def total(values: jax.Array) -> jax.Array:
        return jnp.zeros(voxels, values.dtype).at[voxel].add(values, mode="drop")

    def most(values: jax.Array, least: int) -> jax.Array:
        return jnp.full(voxels, least, jnp.int32).at[voxel].max(values, mode="drop")

    single = total(jnp.ones(count, jnp.int32)) <= 1
    owner = most(row, 0)
    weight = root_weight**2
    sum_weight = total(weight)
    share = 1 / jnp.maximum(sum_weight, 1e-30)
    new_mean = each(lambda o: total(weight * o) * share, offset)
    new_mean = each(lambda m, o: jnp.where(single, o[owner], m), new_mean, offset)

    # Rows of the rotated axes; their products give the spread.
    turned = [_rotated(rotation, split(axes[:, k].astype(jnp.float32))) for k in range(3)]
    place = jnp.minimum(voxel, voxels - 1)
    apart = each(lambda o, m: o - m[place], offset, new_mean)

    def spread(i: int, j: int) -> jax.Array:
        own = sum(axis[i] * axis[j] for axis in turned)
        return total(weight * (own + apart[i] * apart[j])) * share

    pairs = {(i, j): spread(i, j) for i in range(3) for j in range(i, 3)}
    matrix = jnp.stack(
        [jnp.stack([pairs[min(i, j), max(i, j)] for j in range(3)], -1) for i in range(3)], -2
    )
    thickness = jnp.maximum(length(turned[2]), 1e-6)
    facing = join(each(lambda n: total(weight * n / thickness) * share, turned[2]))
    merged = patches.axes_of(matrix, facing)
    kept = jnp.stack([join(each(lambda a: a[owner], axis)) for axis in turned], axis=1)

    hidden = most((passes < 0).astype(jnp.int32), 0) > 0
    sum_passes = total(jnp.abs(passes))
    most_hits = jnp.zeros(voxels, jnp.float32).at[voxel].max(hits, mode="drop")
    new = EvidenceWindow(
        start=jnp.zeros(3, jnp.int32),
        hits=jnp.where(surest == _SURFACE, total(hits), most_hits),
        passes=jnp.where(hidden, -sum_passes, sum_passes),
        behind=total(behind),
        weight=sum_weight,
        mean=join(new_mean),
        axes=jnp.where(single[:, None, None], kept, merged),
        change=most(change, -128),
    )
    return new, surest


def _move_free_space(
    source: Config, evidence: Evidence, target: Config, pose: jax.Array
) -> _FreeSpace:
    """Finds what the rays say of the new voxels that have no patch.

    A voxel has the least passes of all voxels that it overlaps. Its ratio of passes to rays that
    ended before it, which says whether it is free, is that of the voxel at its center.
    """
    rotation, shift = pose[:3, :3], split(pose[:3, 3] / target.voxel_size)
    hits, passes, behind, change = (
        array.ravel()
        for array in (evidence.hits, evidence.passes, evidence.behind, evidence.change)
    )
    passes, behind = passes.astype(jnp.float32), behind.astype(jnp.float32)
    shape = target.grid_shape
    row = jnp.arange(shape[0] * shape[1] * shape[2], dtype=jnp.int32)
    center = _center(target, geometry.unflatten(shape, row))
    point = _rotated(rotation.T, each(jnp.subtract, center, shift))
    cell = each(jnp.floor, point)
    by_hits = (hits > 0) & (passes == 0)
    seen = jnp.where(by_hits, _SEEN, jnp.maximum(passes, 0))

    # Boxes overlap unless one of their axes separates them; six of the fifteen are tested.
    def reach(axis: int) -> jax.Array:
        return 0.5 + 0.5 * jnp.sum(jnp.abs(rotation), axis=axis) - _OVERLAP_VOXELS

    reach_source, reach_target = split(reach(0)), split(reach(1))

    def compare(k: jax.Array, least: jax.Array) -> jax.Array:
        steps = (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)
        other = each(lambda c, s: c + s, cell, steps)
        apart = each(lambda o, p: o + 0.5 - p, other, point)
        near = each(lambda a, r: jnp.abs(a) < r, apart, reach_source)
        near += each(lambda a, r: jnp.abs(a) < r, _rotated(rotation, apart), reach_target)
        index, inside = _index_of(source, other)
        value = jnp.where(inside, seen[geometry.flat_index(source.grid_shape, index)], 0)
        overlaps = near[0] & near[1] & near[2] & near[3] & near[4] & near[5]
        return jnp.where(overlaps, jnp.minimum(least, value), least)

    start = varying_like(jnp.full(row.shape, jnp.inf, jnp.float32), seen, pose)
    least = jax.lax.fori_loop(0, 27, compare, start)
    least = jnp.where(jnp.isfinite(least), least, 0)

    index, inside = _index_of(source, cell)
    own = geometry.flat_index(source.grid_shape, index)
    passes, behind = (jnp.where(inside, array[own], 0) for array in (passes, behind))
    changed = jnp.where(inside & (hits[own] == 0), change[own], 0)
    at_hits = inside & (hits[own] > 0)
    share = least / jnp.where(passes > 0, passes, 1)
    blocked = jnp.where(at_hits, jnp.maximum(behind, 1), behind)
    return _FreeSpace(
        passes=jnp.where(passes < 0, passes, least),
        behind=jnp.where(passes > 0, share * behind, blocked),
        change=changed,
    )


def _center(config: Config, index: Vector) -> Vector:
    """Returns the centers of voxels, voxels of the world frame."""
    return each(lambda i, first: (i + first).astype(jnp.float32) + 0.5, index, config.corner_index)


def _index_of(config: Config, cell: Vector) -> tuple[Vector, jax.Array]:
    """Finds the indices of voxels of the world frame, and which of them the grid has."""
    local = each(lambda c, first: c - first, cell, config.corner_index)
    x, y, z = each(lambda i, n: (i >= 0) & (i < n), local, config.grid_shape)
    inside = x & y & z
    return each(lambda i: jnp.where(inside, i, 0).astype(jnp.int32), local), inside


def _rotated(rotation: jax.Array, vector: Vector) -> Vector:
    """Rotates vectors; by hand, since a matrix product may run in reduced precision on a GPU."""
    x, y, z = vector
    first, second, third = (row[0] * x + row[1] * y + row[2] * z for row in rotation)
    return first, second, third
