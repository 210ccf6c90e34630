"""Surface patches finer than a voxel: running weighted mean and principal axes of its hits.

The spread of the hits shows what lies in a voxel: a disk is a piece of a wall, a rod is a table
leg, a ball is a corner. Principal axes are stored instead of a covariance matrix. Queries need the
axes, and the matrix follows from them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import EvidenceWindow, rounded
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.masks import running_sum
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, length, split

# Half extent of a patch along a principal axis, in standard deviations. Uniform hits have sqrt(3);
# noise widens the spread, so it is a little less. Measured: 0.60 instead of 0.62 cm on a depth
# stream, 0.71 instead of 0.73 cm on a LiDAR stream.
EXTENT_DEVIATIONS = 0.9 * 3**0.5

# Between these distances of its center, voxels, a patch shrinks by up to this share. At the edges
# of surfaces, patches reach beyond the surface: points off the edge would be too near. Next to a
# wall, smaller patches would leave gaps. With 0.2, the distances on a LiDAR stream are 0.05 cm
# larger on average.
_FAR_SHRINKING = 0.14
_FAR_VOXELS = (2.0, 5.0)

# A patch may reach this far out of its voxel, voxels. Otherwise narrow gaps open between patches,
# and the distances before surfaces that a LiDAR saw are 0.03 cm larger on average.
_BEYOND_VOXEL = 0.1

# Shorter axes (voxels) are stored with this length, so that a perfect plane keeps its normal.
_LEAST_DEVIATION = 1e-3

# What two patches of one voxel may become, voxels; `load` refuses a longer axis.
_LONGEST_DEVIATION = 0.99

# The direction of shorter axes (voxels; twice the least) is rounding noise.
_LEAST_DIRECTED = 2e-3

_JACOBI_SWEEPS = 5

# Eigenvalues closer than this share of the largest one are rounding, to derivatives.
_LEAST_GAP = 1e-6

# Smaller patches (voxels^2) need as many hits as a patch of this area: stray returns are small too.
# With 0.2, the demo loses 0.3 % more of its thin parts, and the house loses nothing.
_LEAST_AREA = 0.18

# A patch below this area (voxels^2) needs this share of that if its returns are sharp: noise did
# not put them beside their surface. Their standard deviation is at most this many voxels, and they
# are at least this many: fewer are remains of what moves. Thin things are lost otherwise.
_SMALL_AREA = 0.5
_SHARP_SHARE = 0.6
_SHARP_VOXELS = 0.2
_SHARP_HITS = 6

# A patch needs this many hits per ray that ended just before its voxel: fewer are noise behind a
# surface. The first number holds where no ray passed, the second one elsewhere. Without them, twice
# as many changes of more than 5 mm along 2.5 mm remain.
_LEAST_HITS_BEHIND = (0.1, 0.03)

# A voxel in which at least this share of the rays ended may hold a surface. A single hit, which may
# be stray, needs more.
_DOUBT_RATIO = 0.02
_SINGLE_DOUBT_RATIO = 0.15


def fuse_hits(config: Config, window: EvidenceWindow, rays: Rays) -> EvidenceWindow:
    """Merges the ends of rays into the surface statistics of their voxels.

    Args:
        config: The map's configuration.
        window: The evidence around the sensor.
        rays: The cloud; rows that do not end on a surface change nothing.

    Returns:
        The window with new hits, weight, mean and axes.
    """
    start, points_world, sensor_world = window.start, rays.points_world, rays.sensor_world
    count = points_world.shape[0]
    shape = window.hits.shape
    voxels = shape[0] * shape[1] * shape[2]
    index, offset, inside = geometry.voxel_of_window(config, start, shape, points_world)
    voxel = jnp.where(rays.ends & inside, geometry.flat_index(shape, split(index)), voxels)

    # Sorted by voxel, so that sums cost the size of the cloud and not that of the grid.
    order = jnp.argsort(voxel)
    voxel, offset = voxel[order], offset[order]
    first = jnp.concatenate([jnp.ones(1, bool), voxel[1:] != voxel[:-1]])
    group = running_sum(first.astype(jnp.int32)) - 1
    target = jnp.full(count, voxels, voxel.dtype).at[group].set(voxel)
    used = (voxel < voxels).astype(jnp.float32)

    noise_floor, _ = config.range_noise
    weight = used * (noise_floor / rays.sigma[order]) ** 2
    offset = jnp.where(used[:, None] > 0, offset, 0)

    def total(values: jax.Array) -> jax.Array:
        return jax.ops.segment_sum(values, group, count, indices_are_sorted=True)

    new_hits, new_weight = total(used), total(weight)
    share = 1 / _or_one(new_weight)
    new_mean = total(weight[:, None] * offset) * share[:, None]
    centered = offset - new_mean[group]
    products = centered[:, :, None] * centered[:, None, :]
    new_spread = total(weight[:, None, None] * products) * share[:, None, None]

    # Chan's rule merges the two means and covariances.
    old_hits, old_weight, old_mean, old_axes = (
        array.reshape(voxels, *array.shape[3:])[jnp.minimum(target, voxels - 1)].astype(jnp.float32)
        for array in (window.hits, window.weight, window.mean, window.axes)
    )
    old_spread = jnp.einsum("nki,nkj->nij", old_axes, old_axes)
    part = new_weight / _or_one(old_weight + new_weight)
    step = new_mean - old_mean
    mean = old_mean + part[:, None] * step
    spread = (
        (1 - part)[:, None, None] * old_spread
        + part[:, None, None] * new_spread
        + (part * (1 - part))[:, None, None] * step[:, :, None] * step[:, None, :]
    )
    deviation, direction = principal_axes(spread)
    target_index = jnp.stack(jnp.unravel_index(jnp.minimum(target, voxels - 1), shape), axis=-1)
    center_world = geometry.voxel_center(config, start + target_index)
    to_sensor = (sensor_world - center_world) / config.voxel_size - mean
    direction = _face_sensor(deviation, direction, to_sensor)
    axes = jnp.maximum(deviation, _LEAST_DEVIATION)[:, :, None] * direction

    def put(array: jax.Array, values: jax.Array) -> jax.Array:
        flat = array.reshape(voxels, *array.shape[3:])
        return flat.at[target].set(values.astype(array.dtype), mode="drop").reshape(array.shape)

    return window._replace(
        hits=put(window.hits, old_hits + new_hits),
        weight=put(window.weight, old_weight + new_weight),
        mean=put(window.mean, mean),
        axes=put(window.axes, axes),
    )


def _or_one(weight: jax.Array) -> jax.Array:
    """Replaces 0 by 1, whose inverse has a finite derivative."""
    return jnp.where(weight > 0, weight, 1)


def _face_sensor(deviation: jax.Array, direction: jax.Array, to_sensor: jax.Array) -> jax.Array:
    """Turns the last principal axis, the normal, to the sensor's side.

    The axes become right-handed, so that the first two give the normal.

    Hits on a line do not determine the normal. There it is the part of the direction to the sensor
    that is perpendicular to the line, since the surface was seen from there.

    Args:
        deviation: Standard deviations along the axes, descending, (N, 3) voxels.
        direction: The axes, unit vectors as rows, (N, 3, 3).
        to_sensor: (N, 3) voxels.

    Returns:
        The axes, (N, 3, 3).
    """
    along = jnp.sum(direction * to_sensor[:, None, :], axis=-1)
    directed = deviation >= _LEAST_DIRECTED
    faces_away = along[:, 2:] < 0
    first, normal = direction[:, 0], jnp.where(faces_away, -1.0, 1.0) * direction[:, 2]
    across = to_sensor - jnp.where(directed[:, :1], along[:, :1], 0) * first
    far = length(split(across))[:, None]
    line = ~directed[:, 1:2] & (far > 1e-3)
    normal = jnp.where(line, across / jnp.maximum(far, 1e-3), normal)
    return jnp.stack([first, jnp.cross(normal, first), normal], axis=1)


def axes_of(spread: jax.Array, facing: jax.Array) -> jax.Array:
    """Makes the axes of patches from the moments of several.

    Args:
        spread: Covariance of the hits, (N, 3, 3) voxels^2.
        facing: Mean of the normals, (N, 3): the new normal is on this side.

    Returns:
        As in `Evidence`, (N, 3, 3).
    """
    deviation, direction = principal_axes(spread)
    direction = _face_sensor(deviation, direction, facing)
    return jnp.clip(deviation, _LEAST_DEVIATION, _LONGEST_DEVIATION)[..., None] * direction


def keep_surfaces(config: Config, window: EvidenceWindow, surface: jax.Array) -> EvidenceWindow:
    """Limits the passes of patches that were surface, so that adding them up carves none.

    Args:
        config: The map's configuration.
        window: Evidence that was added up, faded and not rounded.
        surface: Voxels in which a part of it was surface, (X, Y, Z) bool.

    Returns:
        The evidence, by which all of these voxels are surface, also when stored.
    """
    hits = jnp.where(surface, jnp.maximum(window.hits, config.min_hits), window.hits)
    axes = rounded(window.axes)
    weight = rounded(jnp.sqrt(window.weight)) ** 2
    stays = is_feature(config, rounded(hits), rounded(window.passes), weight, axes)
    most = 0.998 * hits * (1 / least_hit_ratio(config, hits, weight, axes) - 1)
    limited = jnp.clip(window.passes, -most, most)
    return window._replace(hits=hits, passes=jnp.where(surface & ~stays, limited, window.passes))


def is_feature(
    config: Config, hits: jax.Array, passes: jax.Array, weight: jax.Array, axes: jax.Array
) -> jax.Array:
    """Returns a mask of the voxels whose patch counts as surface.

    The voxel must have enough hits, and few passes. A patch that fills its voxel stops every ray; a
    table leg lets most rays pass beside it. The required share of hits is therefore proportional to
    the patch's area.

    Args:
        config: The map's configuration.
        hits: Rays that ended in the voxel, (...).
        passes: Rays that went through it, (...).
        weight: Summed weights of the hits, (...).
        axes: As in `Evidence`, (..., 3, 3).

    Returns:
        (...) bool.
    """
    ratio = least_hit_ratio(config, hits, weight, axes)
    return (hits >= config.min_hits) & (hits >= ratio * (hits + jnp.abs(passes)))


def least_hit_ratio(
    config: Config, hits: jax.Array, weight: jax.Array, axes: jax.Array
) -> jax.Array:
    """Returns the share of rays that must have ended on patches, (...).

    Args:
        config: The map's configuration.
        hits: Rays that ended in the voxel, (...).
        weight: Summed weights of the hits, (...).
        axes: As in `Evidence`, (..., 3, 3).

    Returns:
        hits / (hits + passes) below which the patch is carved.
    """
    area = _area(axes)
    # A hit weighs (floor / sigma)^2, so this compares the harmonic mean of the variances.
    noise_floor, _ = config.range_noise
    sharp = weight * (_SHARP_VOXELS * config.voxel_size) ** 2 >= hits * noise_floor**2
    sharp &= is_small(axes) & (hits >= _SHARP_HITS)
    share = jnp.where(sharp, _SHARP_SHARE, 1.0)
    return share * config.min_hit_ratio * jnp.maximum(area, _LEAST_AREA)


def is_small(axes: jax.Array) -> jax.Array:
    """Returns a mask of the patches that fill only a part of their voxel, such as those of poles.

    Args:
        axes: As in `Evidence`, (..., 3, 3).

    Returns:
        (...) bool.
    """
    return _area(axes) < _SMALL_AREA


def _area(axes: jax.Array) -> jax.Array:
    """Computes the areas of patches, at most those of a voxel's face, (...) voxels^2."""
    long, middle = (
        length(split(axes[..., axis, :].astype(jnp.float32))) * EXTENT_DEVIATIONS for axis in (0, 1)
    )
    return jnp.minimum(2 * long, 1) * jnp.minimum(2 * middle, 1)


def is_behind_surface(hits: jax.Array, passes: jax.Array, behind: jax.Array) -> jax.Array:
    """Returns a mask of the voxels whose hits are noise behind a surface.

    Args:
        hits: Rays that ended in the voxel, (...).
        passes: Rays that went through it, (...).
        behind: Rays that ended a little before it, (...).

    Returns:
        (...) bool.
    """
    return hits < jnp.where(passes > 0, _LEAST_HITS_BEHIND[1], _LEAST_HITS_BEHIND[0]) * behind


def is_doubtful(hits: jax.Array, passes: jax.Array) -> jax.Array:
    """Returns a mask of the voxels that may hold a surface, with weaker demands.

    Args:
        hits: Rays that ended in the voxel, (...).
        passes: Rays that went through it, (...).

    Returns:
        (...) bool.
    """
    ratio = jnp.where(hits < 1.5, _SINGLE_DOUBT_RATIO, _DOUBT_RATIO)
    return (hits > 0) & (hits >= ratio * (hits + jnp.maximum(passes, 0)))


class OnPatch(NamedTuple):
    """Where points are from a patch.

    Attributes:
        offset: Vectors from the patch's nearest point to the points, (...) voxels each.
        slope: Derivatives of the length of `offset` by the points, (...) each.
    """

    offset: Vector
    slope: Vector


def nearest_on_patch(
    point: Vector, mean: Vector, axes: tuple[Vector, Vector], center: Vector
) -> OnPatch:
    """Finds the nearest point of a patch.

    A patch is the rectangle around `mean` that its two longest principal axes span. One or both
    axes are short for rods and single hits. The axes of a square turn with the noise, so the
    rectangle's corners may lie outside of the voxel, where no hit was. The rectangle's nearest
    point is therefore moved into the voxel, or to a tenth of a voxel from it.

    Args:
        point: Voxels.
        mean: Center of the patch, same frame and unit.
        axes: The first two principal axes as in `Evidence`, voxels.
        center: Center of the patch's voxel, same frame and unit.

    Returns:
        The offset and its slope. The length of the offset is the distance.
    """
    from_mean = offset = each(jnp.subtract, point, mean)
    start, end = (far**2 for far in _FAR_VOXELS)
    away = (dot(offset, offset) - start) / (end - start)
    far = jnp.clip(away, 0, 1)
    extent = EXTENT_DEVIATIONS * (1 - _FAR_SHRINKING * far)
    spans = []
    for axis in axes:
        half = each(lambda a: extent * a, axis)
        square = jnp.maximum(dot(half, half), 1e-12)
        share = dot(offset, half) / square
        along = jnp.clip(share, -1, 1)
        offset = each(lambda o, h, along=along: o - along * h, offset, half)
        within = share == along
        spans.append((half, jnp.where(within, 1 / square, 0), jnp.where(within, 0, along)))
    most = 0.5 + _BEYOND_VOXEL
    inside = each(
        lambda p, o, c: jnp.clip(p - o, c - most, c + most) - (p - o), point, offset, center
    )
    offset = each(jnp.subtract, offset, inside)
    distance = jnp.maximum(length(offset), 1e-9)
    direction = each(lambda o: o / distance, offset)
    # The nearest point follows the point along the axes on whose ends it does not lie. That changes
    # the distance only where it was moved into the voxel. The ends draw back as the point moves
    # away.
    moved = each(lambda d, i: jnp.where(i == 0, d, 0), direction, inside)
    slope = direction
    drawn_back = jnp.zeros_like(distance)
    for half, per_square, end_of in spans:
        toward = dot(moved, half)
        follows = toward * per_square
        slope = each(lambda s, h, follows=follows: s - follows * h, slope, half)
        drawn_back += toward * end_of
    rate = 2 * _FAR_SHRINKING * EXTENT_DEVIATIONS / (extent * (end - start))
    drawn_back = jnp.where(far == away, rate * drawn_back, 0)
    return OnPatch(offset, each(lambda s, o: s + drawn_back * o, slope, from_mean))


@jax.custom_jvp
def principal_axes(spread: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Decomposes symmetric 3x3 matrices by Jacobi rotations, vectorized over the batch.

    LAPACK and cuSOLVER process matrices one by one: 40,000 take 160 ms on two cores, 10 ms here.
    Differentiable once; axes that are equally long do not turn, and those of length 0 do not grow.

    Args:
        spread: Symmetric, positive semi-definite, (..., 3, 3).

    Returns:
        deviation: Square roots of the eigenvalues, descending, (..., 3).
        direction: Unit eigenvectors as rows, in the same order, (..., 3, 3).
    """
    a = {(i, j): spread[..., i, j] for i in range(3) for j in range(i, 3)}
    one, zero = jnp.ones_like(spread[..., 0, 0]), jnp.zeros_like(spread[..., 0, 0])
    v = [[one if i == j else zero for j in range(3)] for i in range(3)]  # v[k]: k-th eigenvector

    def sweep(_: jax.Array, carry: tuple[dict, list]) -> tuple[dict, list]:
        a, v = dict(carry[0]), [list(row) for row in carry[1]]
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            off = a[p, q]
            gap = a[q, q] - a[p, p]
            # t = tan of the angle that makes a[p, q] zero, the smaller of the two.
            safe = jnp.where(off == 0, one, off)
            theta = jnp.clip(0.5 * gap / safe, -1e15, 1e15)
            sign = jnp.where(theta < 0, -one, one)
            t = jnp.where(off == 0, zero, sign / (jnp.abs(theta) + jnp.sqrt(theta * theta + 1)))
            c = 1 / jnp.sqrt(t * t + 1)
            s = t * c
            pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
            a[pr], a[qr] = c * a[pr] - s * a[qr], s * a[pr] + c * a[qr]
            a[p, p], a[q, q] = a[p, p] - t * off, a[q, q] + t * off
            a[p, q] = zero
            for k in range(3):
                v[p][k], v[q][k] = c * v[p][k] - s * v[q][k], s * v[p][k] + c * v[q][k]
        return a, v

    a, v = jax.lax.fori_loop(0, _JACOBI_SWEEPS, sweep, varying_like((a, v), a))
    value = jnp.stack([a[0, 0], a[1, 1], a[2, 2]], axis=-1)
    vector = jnp.stack([jnp.stack(row, axis=-1) for row in v], axis=-2)
    order = jnp.argsort(-value, axis=-1)
    deviation = jnp.sqrt(jnp.maximum(jnp.take_along_axis(value, order, axis=-1), 0))
    return deviation, jnp.take_along_axis(vector, order[..., None], axis=-2)


@principal_axes.defjvp
def _principal_axes_jvp(primals: Any, tangents: Any) -> Any:
    """Perturbs eigenvalues and eigenvectors to first order."""
    (spread,), (change,) = primals, tangents
    deviation, direction = principal_axes(spread)
    exact = jax.lax.Precision.HIGHEST
    change = jnp.einsum("...ik,...kl,...jl->...ij", direction, change, direction, precision=exact)
    value = deviation**2
    grown = jnp.diagonal(change, axis1=-2, axis2=-1)
    longest = jnp.maximum(value[..., :1], 1e-30)
    long = value > _LEAST_GAP * longest
    by_deviation = jnp.where(long, 0.5 * grown / jnp.where(long, deviation, 1), 0)
    gap = value[..., :, None] - value[..., None, :]
    apart = jnp.abs(gap) > _LEAST_GAP * longest[..., None]
    turn = jnp.where(apart, change / jnp.where(apart, gap, 1), 0)
    by_direction = jnp.einsum("...ij,...jk->...ik", turn, direction, precision=exact)
    return (deviation, direction), (by_deviation, by_direction)
