"""The grid's answers at any point: nearest patches, doubt and frontier.

The patches that the eight surrounding voxels know are evaluated at the point itself. Their mean is
weighted by trilinear interpolation, so that the distance is continuous where the voxels change, and
by nearness, so that it is close to the least of the eight.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.numerics.barriers import compute_once, differentiate_once
from hiosdf_jax._src.numerics.point_kernel import by_points
from hiosdf_jax._src.numerics.vectors import (
    Vector,
    cross,
    dot,
    each,
    join,
    length,
    split,
    take,
    unit,
)
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Derived, Side, Surface, frontier_step_m

# A patch's weight falls by 1 / e for each of these distances that it is farther than the nearest
# one, voxels. Twice as much rounds off corners: 0.25 instead of 0.18 cm in a small room. Half as
# much leaves more steps where the eight voxels change.
_SOFT_VOXELS = 0.14

# Where signs differ, the sign is a mean of its own. Next to patches it has the weights of the
# distance. Away from them, between these distances, voxels, it has the weights to a power that
# falls to this one: otherwise the distance would fall steeply from one sign to the other.
_SIGN_POWER = 0.3
_SIGN_VOXELS = (0.2, 0.45)

# The only patch around a point counts also where its trilinear weight is 0.
_LEAST_WEIGHT = 1e-6

# A patch whose sign differs from that of the space around the point counts up to the first
# distance, voxels. From there on its distance falls by the slope, is 0 within 0.7 voxels, and ends
# with the sign of the space.
_OWN_SIGN_VOXELS = 0.4
_OWN_SIGN_SLOPE = 1.4

# Behind the plane of a patch, its height counts this many times, up to the distance. Beside the
# patch, the height alone would be too near.
_BEHIND_SLOPE = 1.5

# The mean surface is that of patches up to the first distance, voxels, with normals up to about 45
# degrees off. The weight falls by 1 / e for each of the second distance.
_MOVED_VOXELS = 0.5
_MOVED_COSINE = 0.7
_MOVED_SOFT_VOXELS = 0.3

# For registration, patches count by 1 / e less for each of the first distance, and up to about 45
# degrees off.
_PLANE_VOXELS = 0.5
_PLANE_COSINE = 0.7

# A voxel is either observed or not, even where its distance to the frontier is 0, m.
_LEAST_FRONTIER = 1e-6


class Nearest(NamedTuple):
    """The nearest patches of points.

    Attributes:
        sdf: Signed distance to the patches, (...) m; the horizon where none is within it.
        spread: Standard deviation of the patches' hits along their normals, (...) m; 0 without one.
    """

    sdf: jax.Array
    spread: jax.Array


def nearest_patch(config: Config, surface: Surface, points_world: jax.Array) -> Nearest:
    """Finds the nearest of the patches that the eight voxels around a point know.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        The mean of the nearest patches. Differentiable by the points.
    """
    return by_points(nearest_patch_at, config, surface, points_world)


def nearest_patch_at(
    config: Config, surface: Surface, point: Vector, side_point: Vector | None = None
) -> Nearest:
    """Computes `nearest_patch` at points.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        point: (...) m each.
        side_point: The same points, if the derivative by `point` shall hold the sides of space
            fixed: where they change, the slope of the distance is not the normal of a surface.

    Returns:
        As `nearest_patch`.
    """
    point = geometry.clamp(config, point)
    corners = geometry.corners_of(config, point)
    patch = _patches_at(config, surface, corners, point)
    found, distance = patch.found, patch.distance

    side = surface.derived.side.ravel()[corners.flat]
    around = corners
    if side_point is not None:
        around = geometry.corners_of(config, geometry.clamp(config, side_point))
    value = _signed(patch, side, _space_at(config, surface.derived, around, side, point))
    value = jnp.where(found, value, 0)

    # It cancels from the means, and so does its derivative.
    least = jnp.min(jax.lax.stop_gradient(jnp.where(found, distance, jnp.inf)), axis=0)
    any_found = least < jnp.inf
    # Not by a minimum: at the nearest patch it would halve the derivative.
    lag = jnp.where(found, distance - least, 0) / _SOFT_VOXELS
    share = jnp.where(found, jnp.maximum(corners.weight, _LEAST_WEIGHT), 0)
    weight = share * jnp.exp(-lag)
    weight = weight / jnp.where(any_found, jnp.sum(weight, axis=0), 1)
    sdf = _mean_with_softer_sign(weight, share, lag, distance, value)
    spread = jnp.sum(weight * patch.spread, axis=0)
    sdf_m = jnp.where(any_found, sdf * config.voxel_size, config.distance_horizon)
    return Nearest(sdf_m, spread * config.voxel_size)


def _mean_with_softer_sign(
    weight: jax.Array, share: jax.Array, lag: jax.Array, distance: jax.Array, value: jax.Array
) -> jax.Array:
    """Computes the mean of the signed distances to patches, (8, ...) voxels.

    Where their signs differ, it is the mean of their sizes times a mean of their signs.
    """
    mean = jnp.sum(weight * value, axis=0)
    fixed = jax.lax.stop_gradient(value)
    differ = (jnp.max(fixed, axis=0) > 0) & (jnp.min(fixed, axis=0) < 0)
    size = jnp.abs(value)
    start, end = _SIGN_VOXELS
    away = jnp.clip((jnp.sum(weight * distance, axis=0) - start) / (end - start), 0, 1)
    share = share * jnp.exp(-(1 + away * (_SIGN_POWER - 1)) * lag)
    total = jnp.sum(share * size, axis=0)
    sign = jnp.sum(share * value, axis=0) / jnp.where(differ & (total > 0), total, 1)
    return jnp.where(differ, sign * jnp.sum(weight * size, axis=0), mean)


class MeanPlane(NamedTuple):
    """The planes of the patches near points.

    Attributes:
        height: Height of the point above the plane, on the sensor's side, (...) m.
        normal: Unit vectors, (...) each.
        beside: How far the point is from the patches' middle along the plane, (...) m.
        width: The patches' standard deviation along their shorter side, (...) m.
        spread: As in `Nearest`, (...) m.
        away: Distance to the nearest patch, (...) m; inf where none is within the horizon.
    """

    height: jax.Array
    normal: Vector
    beside: jax.Array
    width: jax.Array
    spread: jax.Array
    away: jax.Array


def nearest_plane_at(config: Config, surface: Surface, point: Vector) -> MeanPlane:
    """Finds the mean plane of the patches near points, to register clouds.

    The normal of a patch that was hit a few times is noise. The mean of eight is less so, and
    larger patches count more.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        point: (...) m each; points outside the bounds take the border's value.

    Returns:
        The planes. Differentiable by the points and the patches, with the patches' weights fixed.
    """
    point = geometry.clamp(config, point)
    corners = geometry.corners_of(config, point)
    patch = _patches_at(config, surface, corners, point)
    away = jnp.where(patch.found, patch.distance, jnp.inf)
    number = jax.lax.broadcasted_iota(jnp.int32, away.shape, 0)
    nearest = number == jnp.argmin(away, axis=0)[None]
    nearest_normal = each(lambda n: jnp.sum(jnp.where(nearest, n, 0), axis=0), patch.normal)
    along = dot(patch.normal, each(lambda n: n[None], nearest_normal))
    nearness = jnp.exp(jnp.minimum(jnp.min(away, axis=0) - patch.distance, 0) / _PLANE_VOXELS)
    weight = jnp.maximum(corners.weight, _LEAST_WEIGHT) * nearness * patch.area
    weight = jnp.where(patch.found & (along > _PLANE_COSINE), weight, 0)
    share = jax.lax.stop_gradient(weight / jnp.maximum(jnp.sum(weight, axis=0), 1e-12))

    def mean(values: jax.Array) -> jax.Array:
        return jnp.sum(share * values, axis=0)

    normal = unit(each(mean, patch.normal))
    offset = each(mean, patch.offset)
    height = dot(normal, offset)
    beside = length(each(lambda o, n: o - height * n, offset, normal))
    voxel = config.voxel_size
    return MeanPlane(
        height=voxel * height,
        normal=normal,
        beside=voxel * beside,
        width=voxel * mean(patch.width),
        spread=voxel * mean(patch.spread),
        away=voxel * jnp.min(away, axis=0),
    )


class OnSurface(NamedTuple):
    """Points that were moved to the surface near them.

    Attributes:
        points_world: (..., 3) m.
        normals: Unit vectors, (..., 3).
        spread: As in `Nearest`, (...) m.
    """

    points_world: jax.Array
    normals: jax.Array
    spread: jax.Array


def move_to_surface(
    config: Config, surface: Surface, points_world: jax.Array, normals: jax.Array
) -> OnSurface:
    """Moves points near patches to the mean of their planes.

    Only patches that are about parallel count, so that creases stay where they are.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m, inside the bounds and near patches.
        normals: Unit normals of the surface there, (..., 3).

    Returns:
        The points on the surface; points without such patches stay as they are.
    """
    point = split(points_world)
    corners = geometry.corners_of(config, point)
    patch = _patches_at(config, surface, corners, point)
    cosine = dot(patch.normal, each(lambda n: n[None], split(normals)))
    near = patch.found & (patch.distance < _MOVED_VOXELS) & (jnp.abs(cosine) > _MOVED_COSINE)
    nearness = jnp.exp(-patch.distance / _MOVED_SOFT_VOXELS)
    weight = jnp.where(near, corners.weight * nearness * patch.area, 0)
    total = jnp.sum(weight, axis=0)
    share = weight / jnp.maximum(total, _LEAST_WEIGHT)
    signed = share * jnp.sign(cosine)
    height_m = jnp.sum(signed * patch.height, axis=0) * config.voxel_size
    normal = join(unit(each(lambda n: jnp.sum(signed * n, axis=0), patch.normal)))
    some = (total > _LEAST_WEIGHT)[..., None]
    return OnSurface(
        jnp.where(some, points_world - height_m[..., None] * normal, points_world),
        jnp.where(some, normal, normals),
        jnp.sum(share * patch.spread, axis=0) * config.voxel_size,
    )


class _Patches(NamedTuple):
    """The patches that the voxels around points know, relative to the points; (8, ...) voxels."""

    found: jax.Array  # bool
    distance: jax.Array  # 0 where none was found
    height: jax.Array  # above the plane, positive on the sensor's side
    offset: Vector  # of the point from the patch's mean
    normal: Vector
    width: jax.Array  # standard deviation of the hits along the shorter side of the patch
    area: jax.Array  # variance of the hits in the plane, voxels^2
    spread: jax.Array


def _patches_at(
    config: Config, surface: Surface, corners: geometry.Corners, point_world: Vector
) -> _Patches:
    """Computes distances of points from the patches that the voxels around them know."""
    jump = take(surface.derived.nearest.reshape(-1, 3), corners.flat)
    corners, jump = compute_once((corners, jump))
    found = corners.inside & (jump[0] != NO_FEATURE)
    # Relative to one voxel's center, so that large coordinates lose no digits.
    first = corners.lowest

    def relative(point_m: jax.Array, first: jax.Array, corner: int) -> jax.Array:
        return (point_m - geometry.center_along(config, first, corner)) / config.voxel_size

    point = differentiate_once(each(relative, point_world, first, config.corner_index))
    # Broadcast here, derivatives by the eight are added before they are summed.
    point = each(lambda p: jnp.broadcast_to(p, found.shape), compute_once(point))
    sites = each(lambda i, j: jnp.where(found, i + j, 0), corners.index, jump)
    row = geometry.flat_index(config.grid_shape, sites)
    found, sites, row = compute_once((found, sites, row))
    means, axes = surface.mean.reshape(-1, 3), surface.axes.reshape(-1, 9)
    center = each(lambda s, f: (s - f).astype(jnp.float32), sites, first)
    mean, center = compute_once((each(jnp.add, take(means, row), center), center))
    fixed = jax.lax.stop_gradient(point)
    spans = take(axes, row), take(axes, row, 3)
    offset, slope = patches.nearest_on_patch(fixed, mean, spans, center)
    away = jnp.where(found, length(offset), 0)
    spread = length(take(axes, row, 6))
    across = cross(take(axes, row), take(axes, row, 3))
    normal = unit(across)
    # Linear in the point, with the exact value and slope: reverse mode need not go back through the
    # nearest points of eight patches.
    distance = away + dot(slope, each(jnp.subtract, point, fixed))
    above = each(jnp.subtract, point, mean)
    height = dot(above, normal)
    distance = jnp.where(found, distance, 0)
    width = length(take(axes, row, 3))
    return _Patches(found, distance, height, above, normal, width, length(across), spread)


class _Space(NamedTuple):
    """What rays have shown of the space around points: shares from 0 to 1, (...)."""

    free: jax.Array
    behind: jax.Array


def _space_at(
    config: Config,
    derived: Derived,
    corners: geometry.Corners,
    side: jax.Array,
    point: Vector,
) -> _Space:
    """Computes which shares of the space around points are free, and which lie behind surfaces.

    In observed space they are interpolated between the observed voxels around the point, so that
    the distance does not jump where free voxels meet voxels behind a surface and no patch lies
    between them. Unobserved voxels guess their sides: what they guess behind a wall would reach
    into the room. In unseen space the voxel that contains the point decides: interpolated guesses
    would push waypoints deeper into new obstacles.
    """
    index, _ = geometry.voxel_around(config, point)
    own = geometry.flat_index(config.grid_shape, index)
    steps = derived.frontier_steps.ravel()
    own_side, observed = derived.side.ravel()[own], steps[own] > 0
    seen = corners.inside & (steps[corners.flat] > 0)
    # Squared: the slope of the distance is then wrong in a narrower seam.
    weight = jnp.where(seen, corners.weight**2, 0)
    total = jnp.where(observed, jnp.sum(weight, axis=0), 1)

    def share(kind: Side) -> jax.Array:
        between = jnp.sum(jnp.where(side == kind, weight, 0), axis=0) / total
        return jnp.where(observed, between, own_side == kind)

    return _Space(share(Side.FREE), share(Side.BEHIND))


def _signed(patch: _Patches, side: jax.Array, space: _Space) -> jax.Array:
    """Computes the signed distance to each of the patches around points, (8, ...) voxels.

    It is the height above the patch's plane, unless the voxel that knows the patch is free or has
    no side. Away from patches all have the sign of the space around the point.
    """
    distance = patch.distance
    height = jnp.where(patch.height < 0, _BEHIND_SLOPE * patch.height, patch.height)
    unsigned = (side == Side.FREE) | (side == Side.UNKNOWN)
    signed = jnp.where(unsigned, distance, jnp.maximum(height, -distance))
    signed = jnp.where(side == Side.SHEET, jnp.abs(patch.height), signed)
    falling = _OWN_SIGN_VOXELS - _OWN_SIGN_SLOPE * (distance - _OWN_SIGN_VOXELS)
    limit = jnp.maximum(jnp.minimum(distance, falling), -distance)
    free = space.free * jnp.maximum(signed, -limit)
    behind = space.behind * jnp.minimum(signed, limit)
    return free + behind + (1 - space.free - space.behind) * signed


def grid_sdf(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the signed distance of the grid alone.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        (...) m; the horizon where no patch is within it. Differentiable by the points.
    """
    return by_points(_grid_sdf_at, config, surface, points_world)


def _grid_sdf_at(config: Config, surface: Surface, point: Vector) -> jax.Array:
    return nearest_patch_at(config, surface, point).sdf


def patch_voxel(config: Config, derived: Derived, index: Vector) -> jax.Array:
    """Finds the voxels whose patches are nearest to voxels.

    Args:
        config: The map's configuration.
        derived: The grid's distances.
        index: Voxel indices, (...) int32 each.

    Returns:
        Indices into the raveled grid, (...) int32; a voxel's own where it knows no patch.
    """
    shape = config.grid_shape
    jump = take(derived.nearest.reshape(-1, 3), geometry.flat_index(shape, index))
    found = jump[0] != NO_FEATURE
    return geometry.flat_index(shape, each(lambda i, j: jnp.where(found, i + j, i), index, jump))


def doubt_distance(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the distance to anything that may be a surface, interpolated between voxel centers.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m. Differentiable.
    """
    return by_points(_doubt_at, config, surface, points_world)


def _doubt_at(config: Config, surface: Surface, point: Vector) -> jax.Array:
    corners = geometry.corners_of(config, point)
    around = surface.derived.doubt.ravel()[corners.flat].astype(jnp.float32)
    # Beyond the bounds: the value of voxels that `grow` adds, so that it changes no old answer.
    around = jnp.where(corners.inside, around, config.distance_horizon)
    return jnp.sum(around * corners.weight, axis=0)


def frontier_distance(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the distance to the nearest unobserved voxel, interpolated between voxel centers.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m; positive in observed voxels, negative in others. Differentiable.
    """
    return by_points(frontier_at, config, surface, points_world)


def frontier_at(config: Config, surface: Surface, point: Vector) -> jax.Array:
    """Computes `frontier_distance` at points, (...) m each."""
    corners = geometry.corners_of(config, point)
    steps = surface.derived.frontier_steps.ravel()
    around = steps[corners.flat].astype(jnp.float32) * frontier_step_m(config)
    around = jnp.where(corners.inside, around, -config.frontier_horizon)
    index, inside = geometry.voxel_around(config, point)
    observed = inside & (steps[geometry.flat_index(config.grid_shape, index)] > 0)
    # Voxels beyond the bounds know nothing, and voxels that `grow` added know nothing until the
    # next update. Next to an observed voxel, unseen space begins half a voxel before the unobserved
    # center. Elsewhere they count as deep as the deepest voxel that knows.
    ignorant = around <= -0.999 * config.frontier_horizon
    deepest = jnp.min(jnp.where(ignorant, jnp.inf, around), axis=0)
    deepest = jnp.where(jnp.isfinite(deepest), deepest, -config.frontier_horizon)
    filled = jnp.where(ignorant, jnp.minimum(deepest, 0), around)
    around = jnp.where(observed, jnp.maximum(around, -0.5 * config.voxel_size), filled)
    between = jnp.sum(around * corners.weight, axis=0)
    signed = jnp.where(
        observed, jnp.maximum(between, _LEAST_FRONTIER), jnp.minimum(between, -_LEAST_FRONTIER)
    )
    # The sign is exact; the slope is that of the interpolation.
    return between + jax.lax.stop_gradient(signed - between)
