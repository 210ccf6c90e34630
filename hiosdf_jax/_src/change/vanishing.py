"""Surfaces that rays look through: they vanish after a few scans, however many hits they have."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.change.directions import View
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow, clear_patches
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.masks import first_true_indices
from hiosdf_jax._src.numerics.modes import run_if
from hiosdf_jax._src.numerics.shifts import count_around, with_neighbors
from hiosdf_jax._src.numerics.vectors import Vector, cross, dot, each, length, split, take, unit

# Patches that one scan can judge, and the same as a share of the window's voxels; the others are
# left to later scans.
_MOST_SUSPECTS = 8192
_SUSPECT_SHARE = 1 / 16

# Rays count as through a patch within this share of its half extents, and this many voxels at
# least: its edges are uncertain.
_INNER_SHARE = 0.7
_LEAST_HALF_VOXELS = 0.15

# Rays that graze a patch may pass beside it.
_LEAST_COSINE = 0.2

# A new surface may move by less than a voxel. Rays that go this much farther are past it, voxels.
_PAST_NEW_VOXELS = 0.5

# A new surface is a thin part with at least this many passes per hit, and this share of the rays
# that a voxel can remember. Boxes that have stood for fewer rays are gone one scan sooner.
_THIN_PASSES = 2.0
_THIN_SHARE = 0.5

# A scan adds doubt by the quarters of a patch that its rays cross: 3 for four quarters, 2 for
# three, 1 for two. Two quarters add 2 if several rays cross them, such as a ring of a LiDAR.
# `vanish_scans` counts scans that add this much.
_DOUBT_PER_SCAN = 2
_SEVERAL_RAYS = 3

# `Evidence.change` of a voxel that has just vanished, and where that is forgotten again: until then
# the network learns such places first.
_GONE = -72
_FORGOTTEN = -64

# A thing has left where at least this many voxels have vanished, at most this many voxels away
# along each axis. Fewer may be parts of a thin thing that stays: rays missed them for a while.
_THING_VOXELS = 16
_THING_REACH = 4

# A patch goes with this many vanished voxels up to two voxels away. Fewer cost accuracy
# in a world that stands still: with 2 of 26 neighbors, 0.61 instead of 0.59 cm on a LiDAR stream.
_LEAST_GONE_NEIGHBORS = 8

# The same for one that a ray crosses, if all rays see past it: thin legs meet few rays. The errors
# of house_depth, house_lidar and the demo stay as they are or fall by 1 %.
_LEAST_GONE_IF_MET = 4

# The same where a thing has left. A patch that no ray crosses needs one more, if all rays see past
# it and one of these holds: it is the only patch left up to two voxels away, or at least one of the
# cloud's rays through its voxel should have ended there, by the share of all rays that did. Where a
# thing has left, one ray through a patch also suffices with `_LEAST_GONE_NEIGHBORS`, if other rays
# do not see past it.
_LEAST_GONE_OF_THING_IF_MET = 3
_LEAST_GONE_OF_THING = 4
_SPREADS = 5  # in one scan

# A patch whose voxel no ray passes goes only if this many times as many neighbors have vanished as
# are left.
_LEAST_GONE_RATIO = 2

# Hits of a surface that is as sure as it can be; one of fewer hits vanishes sooner.
_SURE_HITS = 20.0


def drop_vanished(
    config: Config,
    before: EvidenceWindow,
    window: EvidenceWindow,
    rays: Rays,
    view: View,
    turn: jax.Array,
) -> EvidenceWindow:
    """Removes patches that several scans have looked through since a ray last ended on them.

    A patch on a new surface is removed by one scan that looks half a voxel past it: it may have
    moved on. A part so thin that most rays miss it becomes old instead, unless a ray of the scan
    should have ended on it. The remains of a thing are removed when enough voxels around them have
    vanished, and fewer suffice where a whole thing has left.

    Args:
        config: The map's configuration.
        before: The evidence before the cloud.
        window: The evidence with the cloud's hits and passes.
        rays: The cloud.
        view: The cloud as seen from the sensor.
        turn: Number of the update, () int32.

    Returns:
        The window; vanished voxels are free.
    """
    hit, passed = _met(before, window)
    change = jnp.where(hit, jnp.maximum(window.change, 0), window.change)
    forgetting = passed & has_vanished(change)
    later = jnp.where(change == _FORGOTTEN - 1, 0, change + 1)
    change = jnp.where(forgetting, later, change)
    change = change.astype(jnp.int8)
    window = window._replace(change=change)
    looked_at = passed | (change > 0)
    suspects = (window.hits > 0) & ~hit & (looked_at | with_neighbors(has_vanished(change)))
    voxels = suspects.size
    # Where there are too many, each scan judges other slices of the window: none waits forever.
    most = min(_MOST_SUSPECTS, math.ceil(_SUSPECT_SHARE * voxels))
    slices = 1 + jnp.sum(suspects) // most
    slice_of = jnp.arange(suspects.shape[0], dtype=jnp.int32)[:, None, None]
    suspects &= (slice_of + turn) % slices == 0
    voxel = first_true_indices(suspects, most)
    row = jnp.minimum(voxel, voxels - 1)

    old = change.ravel()[row].astype(jnp.int32)
    crossed, met, looked_past = _look(config, window, rays, view, row)
    hits = window.hits.ravel()[row]
    passes = jnp.abs(window.passes.ravel()[row])
    new_passes = passes - jnp.abs(before.passes.ravel()[row])
    # By the share of all rays that did, at least one of the cloud's should have ended here.
    missed = new_passes * hits >= hits + passes
    # One scan says little of a part that stands among many rays and is so thin that most miss it.
    # From now on it is old.
    thin = (passes >= _THIN_PASSES * hits) & (hits + passes >= _THIN_SHARE * config.evidence_limit)
    moved_on = (old > 0) & looked_past & (missed | ~thin)
    stays_new = (old > 0) & ~looked_past
    doubt = crossed - jnp.minimum(old, 0)
    needed = _DOUBT_PER_SCAN * jnp.ceil(config.vanish_scans * jnp.minimum(hits / _SURE_HITS, 1))
    vanished = ((crossed > 0) & (doubt >= needed)) | moved_on
    counted = jnp.where(stays_new, old, -jnp.minimum(doubt, -_FORGOTTEN))

    def put(array: jax.Array, values: jax.Array) -> jax.Array:
        values = jnp.broadcast_to(values, voxel.shape).astype(array.dtype)
        return array.ravel().at[voxel].set(values, mode="drop").reshape(array.shape)

    # Stray returns vanish too. Away from other changes they belonged to no thing.
    near_change = with_neighbors(is_recent(change)).ravel()[row]
    mark = jnp.where((hits >= config.min_hits) | near_change, _GONE, 0)
    change = put(change, jnp.where(vanished, mark, counted))

    def spread(vanished: jax.Array) -> jax.Array:
        """Adds the remains of objects: edges that few rays meet vanish with their objects."""
        mapped = window.hits > 0

        def once(_: jax.Array, vanished: jax.Array) -> jax.Array:
            now = put(change, jnp.where(vanished, mark, counted))
            gone = has_vanished(now)
            thing = _count_around_rows(gone, row, _THING_REACH) >= _THING_VOXELS
            count = _count_around_rows(gone, row, 2)
            left = _count_around_rows(mapped & ~gone, row, 2)
            most = looked_at.ravel()[row] | (count >= _LEAST_GONE_RATIO * left)
            # `left` counts the patch itself.
            remnant = thing & looked_past & (missed | (left <= 1))
            least = jnp.where(remnant, _LEAST_GONE_OF_THING, _LEAST_GONE_NEIGHBORS)
            least_if_met = jnp.where(thing, _LEAST_GONE_OF_THING_IF_MET, _LEAST_GONE_IF_MET)
            least = jnp.where(looked_past & met, least_if_met, least)
            seen = looked_past | (met & (thing | (crossed > 0)))
            return vanished | ((count >= least) & most & seen)

        return jax.lax.fori_loop(0, _SPREADS, once, vanished)

    many = jnp.sum(has_vanished(change)) >= _LEAST_GONE_IF_MET
    vanished = run_if(many, spread, vanished, before, window, rays)
    window = window._replace(change=put(change, counted))
    return clear_patches(window, jnp.where(vanished, voxel, voxels), mark)


def _count_around_rows(mask: jax.Array, row: jax.Array, reach: int) -> jax.Array:
    """Counts the voxels of a mask in the cubes around some voxels, as `count_around` does for all.

    Args:
        mask: (X, Y, Z) bool.
        row: Indices into the raveled mask, (N,) int32.
        reach: Half the edge of the cubes, without the voxel itself.

    Returns:
        (N,) int32.
    """
    edge = 2 * reach + 1
    if mask.size <= edge**3 * row.size:
        return count_around(mask, reach).ravel()[row].astype(jnp.int32)
    steps = np.indices(3 * (edge,)).reshape(3, -1).T - reach
    index = jnp.stack(jnp.unravel_index(row, mask.shape), axis=-1)[:, None] + steps
    inside = jnp.all((index >= 0) & (index < jnp.asarray(mask.shape)), axis=-1)
    around = geometry.flat_index(mask.shape, split(jnp.where(inside[..., None], index, 0)))
    return jnp.sum(inside & mask.ravel()[around], axis=1, dtype=jnp.int32)


def is_recent(change: jax.Array) -> jax.Array:
    """Returns a mask of the voxels where a surface appeared or vanished in the last scans.

    Args:
        change: As in `Evidence`, (...).

    Returns:
        (...) bool.
    """
    return (change > 0) | has_vanished(change)


def has_vanished(change: jax.Array) -> jax.Array:
    """Returns a mask of the voxels where a surface vanished in the last scans.

    Args:
        change: As in `Evidence`, (...).

    Returns:
        (...) bool.
    """
    return change < _FORGOTTEN


def where_things_left(change: jax.Array) -> jax.Array:
    """Returns a mask of the voxels near which a whole thing has left: many voxels have vanished.

    Args:
        change: As in `Evidence`, (X, Y, Z).

    Returns:
        (X, Y, Z) bool.
    """
    return count_around(has_vanished(change), _THING_REACH) >= _THING_VOXELS


def share_of_changes(
    before: EvidenceWindow, traced: EvidenceWindow, window: EvidenceWindow
) -> jax.Array:
    """Computes how much of the surface a cloud has seen appear or vanish.

    Voxels that this cloud did not look at are not counted: they keep their mark until rays pass
    them, and would look like a change forever. Remains that go without a ray of their own are not
    counted, either.

    Args:
        before: The evidence before the cloud.
        traced: The evidence with the cloud's hits and passes.
        window: The same after surfaces have appeared and vanished.

    Returns:
        Such voxels, per voxel with a surface in the window, () float32.
    """
    hit, passed = _met(before, traced)
    changed = jnp.sum(is_recent(window.change) & (hit | passed))
    return changed / jnp.maximum(jnp.sum(window.hits > 0), 1).astype(jnp.float32)


def _met(before: EvidenceWindow, window: EvidenceWindow) -> tuple[jax.Array, jax.Array]:
    """Returns masks of the voxels in which rays of the cloud ended, and which they passed."""
    return window.hits > before.hits, window.passes > jnp.abs(before.passes)


def _look(
    config: Config, window: EvidenceWindow, rays: Rays, view: View, row: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns doubt in patches, and masks of those that a ray crosses, and that all rays see past.

    Rays see past an old surface if they go a voxel farther, and past a new one from
    `_PAST_NEW_VOXELS` on.
    """
    size, shape = config.voxel_size, window.hits.shape
    index = jnp.stack(jnp.unravel_index(row, shape), axis=-1)
    mean = take(window.mean.reshape(-1, 3), row)
    center_world = split(geometry.voxel_center(config, window.start + index))
    sensor_world = split(rays.sensor_world)
    offset = each(lambda c, m, s: c + m * size - s, center_world, mean, sensor_world)
    distance = length(offset)
    image, filled = view
    pixel = directions.pixel_of(offset)
    is_new = window.change.ravel()[row] > 0
    farther = jnp.where(is_new, _PAST_NEW_VOXELS, 1.0) * size
    past = (filled.farthest[pixel] > distance + farther) & (
        filled.nearest[pixel] > distance + 0.5 * size
    )

    axes = window.axes.reshape(-1, 9)
    long, middle, short = (take(axes, row, first) for first in (0, 3, 6))
    # A flat patch is a rectangle. The rectangle of any other patch faces the sensor.
    flat = length(short) < 0.5 * length(middle)
    unit_long = unit(long)
    away = unit(offset)
    along = dot(away, unit_long)
    facing = unit(each(lambda a, u: a - along * u, away, unit_long))
    normal = each(lambda s, f: jnp.where(flat, s, f), unit(short), facing)
    across = cross(normal, unit_long)
    least = _LEAST_HALF_VOXELS * size

    def half(deviation: jax.Array) -> jax.Array:
        extent = patches.EXTENT_DEVIATIONS * deviation * size
        return jnp.maximum(_INNER_SHARE * extent, least)

    half_long, half_across = half(length(long)), half(length(middle))

    ray = image.row[directions.neighbor_pixels(offset)]
    known = ray >= 0
    direction = take(rays.directions_world, jnp.maximum(ray, 0))
    reach = rays.free_ranges[jnp.maximum(ray, 0)]
    sigma = rays.sigma[jnp.maximum(ray, 0)]

    def wide(vector: Vector) -> Vector:
        return each(lambda v: v[..., None], vector)

    cosine = dot(direction, wide(normal))
    steep = jnp.abs(cosine) >= _LEAST_COSINE
    depth = dot(wide(offset), wide(normal)) / jnp.where(steep, cosine, 1)
    beyond = steep & known & (depth > 0) & (reach > depth + size + 3 * sigma)
    point = each(lambda d, o: d * depth - o, direction, wide(offset))
    u = dot(point, wide(unit_long)) / half_long[..., None]
    v = dot(point, wide(across)) / half_across[..., None]
    crosses = beyond & (jnp.abs(u) < 1) & (jnp.abs(v) < 1)
    # One sum counts the rays through all quarters, in a byte each.
    quarter = 2 * (u < 0).astype(jnp.int32) + (v < 0)
    counts = jnp.where(crosses, jnp.left_shift(jnp.int32(1), 8 * quarter), 0)
    counts = jnp.sum(counts, axis=-1, dtype=jnp.int32)
    counts = [(counts >> (8 * k)) & 255 for k in range(4)]
    none = jnp.zeros(row.shape, jnp.int32)
    quarters = sum(((count > 0).astype(jnp.int32) for count in counts), none)
    several = (quarters == 2) & (sum(counts, none) >= _SEVERAL_RAYS)
    return jnp.where(several, 2, jnp.maximum(quarters - 1, 0)), quarters > 0, past
