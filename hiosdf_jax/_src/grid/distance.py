"""The distance transform: every voxel's nearest surface patch, and its side of it.

Three separable passes, one an axis, each the exact minimum over all sites within the horizon of a
squared distance; the sites lie at their patch's centre, not at their voxel's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.change import Change, Window, recompute
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, length, take
from hiosdf_jax._src.state import Grid, Surface

NO_FEATURE = -128
"""`Surface.nearest` where there is no feature within the horizon."""

_INFINITE = 1e12  # squared voxels

# A voxel is free if at least this many rays went through it for each that ended just before it:
# noise puts some ends of rays too far.
_FREE_RATIO = 0.1

# How far behind a patch free space makes it a sheet: beyond the margin that passes keep, voxels.
_SHEET_VOXELS = 2.0

# Where no ray came by, the plane of a patch tells its side up to here, voxels.
_GUESS_VOXELS = 3.0

# Shifts in either direction that a pass tries at a time.
_CHUNK = 8


class Part(NamedTuple):
    """A box of voxels in an array.

    Attributes:
        start: Its first voxel, three int32 scalars.
        shape: Static.
    """

    start: tuple[jax.Array | int, ...]
    shape: tuple[int, ...]


def nearest_sites(
    sites: jax.Array,
    offset: jax.Array,
    horizon: int,
    part: Part | None = None,
    order: Sequence[int] = (2, 1, 0),
) -> tuple[jax.Array, jax.Array]:
    """Finds each voxel's nearest site by exact passes over the axes.

    Args:
        sites: (X, Y, Z) bool, the voxels that hold a site.
        offset: (X, Y, Z, 3) of the site from its voxel's centre, voxels, in [-0.5, 0.5].
        horizon: Sites farther than this along an axis are not looked for, voxels.
        part: The voxels to find them for; by default all.
        order: Of the passes. Each one cuts the box down to the part along its axis. Where sites lie
            off their voxels' centres the answer can depend on it.

    Returns:
        nearest: (A, B, C) int32, the flat index of the nearest site's voxel; -1 where none is
            within the horizon. Of the part's shape.
        squared: (A, B, C) squared distance of the voxel's centre to it, voxels^2.
    """
    start, shape = part or Part((0, 0, 0), sites.shape)
    nearest = jnp.arange(sites.size, dtype=jnp.int32).reshape(sites.shape)
    squared = jnp.where(sites, jnp.sum(offset * offset, axis=-1), _INFINITE)
    for axis in order:
        # A voxel's candidate lies at some other place along this axis.
        along = offset[..., axis].ravel()[nearest.ravel()].reshape(nearest.shape)
        squared, shift = _pass(squared, along, axis, horizon, start[axis], shape[axis])
        row = jax.lax.broadcasted_iota(jnp.int32, shift.shape, axis) + start[axis] + shift
        nearest = jnp.take_along_axis(nearest, row, axis)
    found = squared <= horizon**2
    return jnp.where(found, nearest, -1), jnp.where(found, squared, _INFINITE)


def pass_order(config: Config) -> list[int]:
    """Short axes first: of the grid, since all windows must give the same answer."""
    return sorted(range(3), key=lambda k: config.grid_shape[k])


def _pass(
    squared: jax.Array,
    along: jax.Array,
    axis: int,
    horizon: int,
    first: jax.Array | int,
    length: int,
) -> tuple[jax.Array, jax.Array]:
    """Least distance over shifts of the candidates along an axis, for `length` voxels of it.

    The candidate of a voxel k further on is at k + along from here, and its distance across the
    axis is the same as there.
    """
    reach = min(horizon, squared.shape[axis] - 1)
    margin = [(0, 0)] * 3
    margin[axis] = (reach, reach)
    across = jnp.pad(squared - along * along, margin, constant_values=_INFINITE)
    along = jnp.pad(along, margin)

    def part(array: jax.Array, size: int) -> jax.Array:
        return jax.lax.dynamic_slice_in_dim(array, first, size, axis)

    def shifted(array: jax.Array, shift: int) -> jax.Array:
        return jax.lax.slice_in_dim(array, reach + shift, reach + shift + length, axis=axis)

    # Cut out once, so that all the shifts are known to the compiler; and a few of them at a time:
    # the barriers keep XLA from computing what they have in common for each shift again.
    best = part(squared, length)
    shift = jnp.zeros(best.shape, jnp.int32)
    across, along = jax.lax.optimization_barrier(
        (part(across, length + 2 * reach), part(along, length + 2 * reach))
    )
    for k in range(1, reach + 1):
        for step in (-k, k):
            candidate = shifted(across, step) + (step + shifted(along, step)) ** 2
            shift = jnp.where(candidate < best, step, shift)
            best = jnp.minimum(best, candidate)
        if k % _CHUNK == 0 or k == reach:
            best, shift = jax.lax.optimization_barrier((best, shift))
    return best, shift


def update_distances(config: Config, grid: Grid, change: Change) -> Grid:
    """Recomputes distances and signs where new evidence can have changed them.

    Args:
        config: The map's configuration.
        grid: The grid, with new evidence.
        change: Where that is.

    Returns:
        The grid with nearest, sdf and doubt as if recomputed everywhere.
    """
    horizon_m = config.horizon_voxels * config.voxel_size

    def inside(window: Window) -> Surface:
        return _distances_in(config, grid, window)

    return grid.replace(surface=recompute(config, change, horizon_m, inside))


def _distances_in(config: Config, grid: Grid, window: Window) -> Surface:
    """The grid's surface with new distances in a window that holds all they can depend on."""
    start, shape, inner_start, inner = window
    within = window.within
    part = Part(within, inner)
    hits, passes, behind, mean, axes = (
        geometry.read_window(array, start, shape)
        for array in (
            grid.hits,
            grid.passes,
            grid.behind,
            grid.surface.mean,
            grid.surface.axes,
        )
    )
    hits, passes, behind, mean = (x.astype(jnp.float32) for x in (hits, passes, behind, mean))
    order = pass_order(config)
    features = patches.is_feature(config, hits, passes, axes)
    nearest, _ = nearest_sites(features, mean, config.horizon_voxels, part, order)
    doubtful = patches.is_doubtful(hits, passes)
    _, squared = nearest_sites(doubtful, mean, config.horizon_voxels, part, order)
    doubt = jnp.minimum(jnp.sqrt(squared) * config.voxel_size, config.distance_horizon)

    # From the centres of the part's voxels to their nearest patches.
    nearest = nearest.ravel()
    found, row = nearest >= 0, jnp.maximum(nearest, 0)
    here = jnp.unravel_index(jnp.arange(nearest.size, dtype=jnp.int32), inner)
    here = each(jnp.add, here, within)
    jump = each(jnp.subtract, jnp.unravel_index(row, shape), here)
    means, spans = mean.reshape(-1, 3), axes.reshape(-1, 9)
    long, middle, short = (take(spans, row, first) for first in (0, 3, 6))
    patch = each(jnp.add, take(means, row), jump)
    offset = patches.patch_offset(each(jnp.zeros_like, patch), patch, (long, middle))
    side = _side(is_free(passes, behind), behind, here, offset, middle, short)
    metres = side * length(offset) * config.voxel_size
    sdf = jnp.where(found, metres, config.distance_horizon)
    jump = jnp.where(found[..., None], join(jump), NO_FEATURE)

    def put(old: jax.Array, values: jax.Array) -> jax.Array:
        values = values.reshape(*inner, *old.shape[3:]).astype(old.dtype)
        return geometry.write_window(old, inner_start, values)

    known = grid.surface
    return known.replace(
        nearest=put(known.nearest, jump), sdf=put(known.sdf, sdf), doubt=put(known.doubt, doubt)
    )


def is_free(passes: jax.Array, behind: jax.Array) -> jax.Array:
    """Tells the voxels that rays have shown to be free: a ray went through, and not by chance.

    Args:
        passes: (...) rays that went through the voxel.
        behind: (...) rays that ended a little before it.

    Returns:
        (...) bool.
    """
    return (passes > 0) & (passes >= _FREE_RATIO * behind)


def _side(
    free: jax.Array,
    behind: jax.Array,
    here: Vector,
    offset: Vector,
    middle: Vector,
    short: Vector,
) -> jax.Array:
    """Sign of voxels' centres: +1 in free space, -1 behind surfaces.

    Away from surfaces the rays through the voxel decide. Within a voxel of a flat patch the side
    of its plane does, since rays end in such a voxel: unless the patch is a sheet, with free space
    behind it as well.

    Args:
        free: (X, Y, Z) bool, what `is_free` says of the window.
        behind: (X, Y, Z) rays that ended a little before the window's voxels.
        here: (N,) indices of the voxels in the window.
        offset: (N,) from the nearest point of the nearest patch to the centre, voxels.
        middle: (N,) the second principal axis of that patch.
        short: (N,) its third, along the normal.

    Returns:
        (N,) float32.
    """
    shape = free.shape
    free, behind = free.ravel(), behind.ravel()
    distance, thickness = length(offset), length(short)
    flat = thickness < 0.5 * length(middle)
    normal = each(lambda a: a / jnp.maximum(thickness, 1e-6), short)
    in_front = dot(offset, normal) >= 0
    beyond = each(lambda h, o, n: h - o - _SHEET_VOXELS * n, here, offset, normal)
    probe = each(lambda b, n: jnp.clip(jnp.round(b).astype(jnp.int32), 0, n - 1), beyond, shape)
    by_plane = in_front | free[geometry.flat_index(shape, probe)]
    own = geometry.flat_index(shape, here)
    unmet = jnp.where(distance < _GUESS_VOXELS, jnp.where(in_front, 1.0, -1.0), 0.0)
    by_rays = jnp.where(behind[own] > 0, -1.0, unmet)
    by_rays = jnp.where(free[own], 1.0, by_rays)
    return jnp.where(flat & (distance < 1), jnp.where(by_plane, 1.0, -1.0), by_rays)
