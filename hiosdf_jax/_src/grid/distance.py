"""Every voxel's nearest surface patch, the distance to it, and the side on which the voxel lies."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.evidence import FREE_RATIO, is_free
from hiosdf_jax._src.grid.nearest import Part, nearest_sites
from hiosdf_jax._src.grid.rays import HIDDEN_VOXELS
from hiosdf_jax._src.grid.rectangles import REACH_VOXELS, nearest_rectangles, with_margin
from hiosdf_jax._src.grid.windows import RayBox, Window, recompute, whole_grid
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, length, take
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Derived, Grid, Side

# Fewer passes suffice far from patches: noise does not put ends of rays there. The share falls from
# `FREE_RATIO` to this one between these distances of the voxel's center from the nearest patch,
# voxels. In the apartment it frees about 150 voxels, 3 of which are solid.
_FAR_FREE_RATIO = 0.02
_FAR_VOXELS = (1.0, 1.5)

# Free space this far behind a patch makes it a sheet: beyond the margin of the passes, voxels.
_SHEET_VOXELS = 2.0

# Where no ray passed, the plane of a patch decides the side up to this distance, voxels. That of a
# new surface decides less: beside a thing that moves, a LiDAR sees nothing above its rings.
_GUESS_VOXELS = 3.0
_GUESS_NEW_VOXELS = 1.0

# The plane of a patch of fewer hits is uncertain: its normal may face away from the sensor.
_SURE_HITS = 10.0

# A patch fills its voxel or lies beside it where the nearest point to the voxel's center is at most
# this far along its plane, voxels. Farther on is the edge of a surface, where the rays decide.
_BESIDE_VOXELS = 0.15

# No ray passes a voxel behind a surface, and this many end before it. The plane may run through it,
# so the voxel's center must be this far from the plane, voxels.
_BLOCKED_RAYS = 3.0
_BLOCKED_VOXELS = 0.2

# Rays mark voxels up to this far behind their ends, those of grazing rays farthest. Where no hits
# are so near, the surface that the rays ended on has vanished.
_HIDDEN_REACH_VOXELS = HIDDEN_VOXELS + 2.0


def axis_order(config: Config) -> list[int]:
    """Returns the grid's axes, short ones first; all windows must use the same order."""
    return sorted(range(3), key=lambda k: config.grid_shape[k])


def update_distances(config: Config, grid: Grid, box: RayBox) -> Grid:
    """Recomputes distances and signs where new evidence can have changed them.

    Args:
        config: The map's configuration.
        grid: The grid, with new evidence.
        box: The rays of the new evidence.

    Returns:
        The grid with nearest, sdf and doubt as if recomputed everywhere.
    """
    horizon_m = (config.horizon_voxels + REACH_VOXELS) * config.voxel_size

    def inside(window: Window) -> Derived:
        return _distances_in(config, grid, window)

    return grid.replace(derived=recompute(config, box, horizon_m, inside))


def recompute_distances(config: Config, grid: Grid) -> Grid:
    """Recomputes the distances and signs of the whole grid."""
    return grid.replace(derived=_distances_in(config, grid, whole_grid(config)))


def find_sites(
    config: Config,
    hits: jax.Array,
    passes: jax.Array,
    behind: jax.Array,
    root_weight: jax.Array,
    axes: jax.Array,
) -> jax.Array:
    """Finds the voxels with a surface patch, and those that may hold a surface.

    Args:
        config: The map's configuration.
        hits: Rays that ended in each voxel, (X, Y, Z) float32.
        passes: Rays that went through it, float32.
        behind: Rays that ended a little before it, float32.
        root_weight: As in `Evidence`, float32.
        axes: As in `Evidence`, (X, Y, Z, 3, 3).

    Returns:
        Both masks, (2, X, Y, Z) bool.
    """
    features = patches.is_feature(config, hits, passes, root_weight**2, axes)
    features &= ~patches.is_behind_surface(hits, passes, behind)
    return jnp.stack([features, patches.is_doubtful(hits, passes)])


def _distances_in(config: Config, grid: Grid, window: Window) -> Derived:
    """Recomputes the distances in a window that holds all that they depend on."""
    start, shape, inner_start, inner = window
    within = window.within
    part = Part(within, inner)
    larger = with_margin(shape, part)
    hits, passes, behind, root_weight, mean, axes, change = (
        geometry.read_window(array, start, shape)
        for array in (
            grid.evidence.hits,
            grid.evidence.passes,
            grid.evidence.behind,
            grid.evidence.root_weight,
            grid.evidence.mean,
            grid.evidence.axes,
            grid.evidence.change,
        )
    )
    hits, passes, behind, root_weight = (
        x.astype(jnp.float32) for x in (hits, passes, behind, root_weight)
    )
    order = axis_order(config)
    sites = find_sites(config, hits, passes, behind, root_weight, axes)
    horizon = config.horizon_voxels
    indices, squares = nearest_sites(sites, mean, horizon, larger, order)
    inside = tuple(a - b for a, b in zip(within, larger.start, strict=True))
    nearest = nearest_rectangles(indices[0], horizon, larger, mean, axes)
    nearest, squared = (geometry.read_window(x, inside, inner) for x in (nearest, squares[1]))
    doubt = jnp.minimum(jnp.sqrt(squared) * config.voxel_size, config.distance_horizon)

    # From the centers of the part's voxels to their nearest patches.
    found, row = nearest >= 0, compute_once(jnp.maximum(nearest, 0))
    here = each(lambda k: within[k] + jax.lax.broadcasted_iota(jnp.int32, inner, k), range(3))
    jump = each(jnp.subtract, geometry.unflatten(shape, row), here)
    means, spans = mean.reshape(-1, 3), axes.reshape(-1, 9)
    long, middle, short = (take(spans, row, first) for first in (0, 3, 6))
    mean = each(jnp.add, take(means, row), jump)
    here_zero = each(jnp.zeros_like, mean)
    offset = patches.nearest_on_patch(here_zero, mean, (long, middle), jump).offset
    sure = hits.ravel()[row] >= _SURE_HITS
    new = change.ravel()[row] > 0
    marked = squared < _HIDDEN_REACH_VOXELS**2
    sign, side = _side(passes, behind, here, offset, middle, short, sure, new, marked)
    signed_m = sign * length(offset) * config.voxel_size
    sdf = jnp.where(found, signed_m, config.distance_horizon)
    side = jnp.where(found, side, Side.UNKNOWN)
    known = grid.derived
    sdf, side = _compute_together(sdf.astype(known.sdf.dtype), side.astype(known.side.dtype))
    jump = jnp.where(found[..., None], join(jump), NO_FEATURE)

    def write(old: jax.Array, values: jax.Array) -> jax.Array:
        return geometry.write_window(old, inner_start, values.astype(old.dtype))

    return known.replace(
        nearest=write(known.nearest, jump),
        sdf=write(known.sdf, sdf),
        side=write(known.side, side),
        doubt=write(known.doubt, doubt),
    )


def _compute_together(sdf: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Has two results computed by one kernel, as one number.

    XLA on a CPU makes one kernel per result, and would gather the patches for each of them, or
    store all that both need.

    Args:
        sdf: (...) float16.
        side: (...) int8.

    Returns:
        The same values.
    """
    bits = jax.lax.bitcast_convert_type(sdf, jnp.uint16).astype(jnp.uint32)
    both = bits | (jax.lax.bitcast_convert_type(side, jnp.uint8).astype(jnp.uint32) << 16)
    both = jax.lax.optimization_barrier(both)
    sdf = jax.lax.bitcast_convert_type(both.astype(jnp.uint16), sdf.dtype)
    return sdf, jax.lax.bitcast_convert_type((both >> 16).astype(jnp.uint8), side.dtype)


def _side(
    passes: jax.Array,
    behind: jax.Array,
    here: Vector,
    offset: Vector,
    middle: Vector,
    short: Vector,
    sure: jax.Array,
    new: jax.Array,
    marked: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Computes the sign of voxels' centers: +1 in free space, -1 behind surfaces.

    Away from surfaces the rays through the voxel decide. Rays end within a voxel of a flat patch,
    so there the side of its plane decides, unless the patch is a sheet with free space on both
    sides. The rays decide there too where the plane is uncertain, or where all of them end before
    the voxel.

    Args:
        passes: Rays that went through the window's voxels, (X, Y, Z).
        behind: Rays that ended a little before the window's voxels, (X, Y, Z).
        here: Indices of the voxels in the window, (...) each.
        offset: From the nearest point of the nearest patch to the center, (...) each, voxels.
        middle: The second principal axis of that patch, (...) each.
        short: Its third axis, along the normal, (...) each.
        sure: That patch has enough hits for a plane, (...) bool.
        new: That patch is on a surface that has just appeared, (...) bool.
        marked: The center is so near to some hits that `behind` may be due to them, (...) bool.

    Returns:
        sign: (...) float32; 0 where nothing decides.
        side: What decides, (...) int8, see `Side`.
    """
    shape = passes.shape
    passes, behind = passes.ravel(), behind.ravel()
    free = is_free(passes, behind)
    distance, thickness = length(offset), length(short)
    flat = thickness < 0.5 * length(middle)
    normal = each(lambda a: a / jnp.maximum(thickness, 1e-6), short)
    height = dot(offset, normal)
    in_front = height >= 0
    beyond = each(lambda h, o, n: h - o - _SHEET_VOXELS * n, here, offset, normal)
    probe = each(lambda b, n: jnp.clip(jnp.round(b).astype(jnp.int32), 0, n - 1), beyond, shape)
    sheet = free[geometry.flat_index(shape, probe)]
    own = geometry.flat_index(shape, here)
    near = distance < jnp.where(new, _GUESS_NEW_VOXELS, _GUESS_VOXELS)
    unobserved = jnp.where(near, jnp.where(in_front, 1.0, -1.0), 0.0)
    by_rays = jnp.where((behind[own] > 0) & marked, -1.0, unobserved)
    start, end = _FAR_VOXELS
    far = jnp.clip((distance - start) / (end - start), 0, 1)
    ratio = FREE_RATIO + far * (_FAR_FREE_RATIO - FREE_RATIO)
    by_rays = jnp.where(is_free(passes[own], behind[own], ratio), 1.0, by_rays)
    blocked = (passes[own] <= 0) & (behind[own] >= _BLOCKED_RAYS) & (distance > _BLOCKED_VOXELS)
    trusted = flat & sure & (distance < 1) & ~blocked
    sign = jnp.where(trusted, jnp.where(in_front | sheet, 1.0, -1.0), by_rays)
    along = jnp.sqrt(jnp.maximum(distance**2 - height**2, 0))
    # In a free voxel in front of a patch the rays say nothing about the space behind it.
    in_front_of_solid = (sign > 0) & in_front & ~sheet & (distance < 1)
    beside = (trusted | in_front_of_solid) & (along < _BESIDE_VOXELS)
    by_plane = jnp.where(sheet, Side.SHEET, Side.PLANE)
    return sign, jnp.where(beside, by_plane, by_rays).astype(jnp.int8)
