"""The grid's distance at any point, from the patches around it.

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
    length,
    take,
    unit,
)
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Derived, Side, Surface

# A patch's weight falls by 1 / e for each of these distances that it is farther than the nearest
# one, voxels. Twice as much rounds off corners: 0.25 instead of 0.18 cm in a small room. Half as
# much leaves more steps where the eight voxels change.
_SOFT_VOXELS = 0.14

# Where signs differ, the sign is a mean of its own. On patches it has the weights of the distance.
# Between these distances from them, voxels, it has the weights to a power that falls to this one:
# otherwise the distance would fall steeply from one sign to the other.
_SIGN_POWER = 0.3
_SIGN_VOXELS = (0.1, 0.3)

LEAST_WEIGHT = 1e-6
"""The only patch around a point counts also where its trilinear weight is 0."""

# A patch whose sign differs from that of the space around the point counts up to the first
# distance, voxels. From there on its distance falls by the slope, is 0 within 0.7 voxels, and ends
# with the sign of the space.
_OWN_SIGN_VOXELS = 0.4
_OWN_SIGN_SLOPE = 1.4

# Behind the plane of a patch, its height counts this many times, up to the distance. Beside the
# patch, the height alone would be too near.
_BEHIND_SLOPE = 1.5


class Nearest(NamedTuple):
    """The nearest patches of points.

    Attributes:
        sdf: Signed distance to the patches, (...) m; the horizon where none is within it.
        spread: Standard deviation of the patches' hits along their normals, (...) m; 0 without one.
        distance: To the nearest patch, (...) m; infinite without one.
    """

    sdf: jax.Array
    spread: jax.Array
    distance: jax.Array


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
    patch = patches_at(config, surface, corners, point)
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
    share = jnp.where(found, jnp.maximum(corners.weight, LEAST_WEIGHT), 0)
    weight = share * jnp.exp(-lag)
    weight = weight / jnp.where(any_found, jnp.sum(weight, axis=0), 1)
    sdf = _mean_with_softer_sign(weight, share, lag, distance, value)
    spread = jnp.sum(weight * patch.spread, axis=0)
    sdf_m = jnp.where(any_found, sdf * config.voxel_size, config.distance_horizon)
    return Nearest(sdf_m, spread * config.voxel_size, least * config.voxel_size)


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


class Patches(NamedTuple):
    """The patches that the eight voxels around points know, relative to the points.

    Attributes:
        found: The voxel knows a patch, (8, ...) bool.
        distance: From the patch, (8, ...) voxels; 0 where none was found.
        slope: Of the distance by the point, (8, ...) each.
        height: Above its plane, (8, ...) voxels, positive on the sensor's side.
        offset: Of the point from the patch's mean, (8, ...) voxels each.
        normal: Unit vectors, (8, ...) each.
        width: Standard deviation of the hits along the shorter side of the patch, (8, ...) voxels.
        area: Variance of the hits in the plane, (8, ...) voxels^2.
        spread: Standard deviation of the hits along the normal, (8, ...) voxels.
    """

    found: jax.Array
    distance: jax.Array
    slope: Vector
    height: jax.Array
    offset: Vector
    normal: Vector
    width: jax.Array
    area: jax.Array
    spread: jax.Array


def patches_at(
    config: Config, surface: Surface, corners: geometry.Corners, point_world: Vector
) -> Patches:
    """Computes distances of points from the patches that the voxels around them know.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        corners: The eight voxels around the points.
        point_world: (...) m each.

    Returns:
        The patches. Differentiable by the points.
    """
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
    return Patches(found, distance, slope, height, above, normal, width, length(across), spread)


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


def _signed(patch: Patches, side: jax.Array, space: _Space) -> jax.Array:
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
