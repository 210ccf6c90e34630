"""What the map says of the returns of a cloud: distance, normal, spread, observed or not."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.queries import query
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.mapping.registration.motion import offsets_from
from hiosdf_jax._src.numerics.vectors import split
from hiosdf_jax._src.state import Baked, Field

# A gradient that is shorter than this lies between surfaces and has no direction.
_LEAST_SLOPE = 0.5

# Points farther from a patch along its plane are beside the surface that is known so far. They
# would pull a cloud back to where the map ends. Narrower patches show no normal. The second values
# are for a map that grows: patches at its border are the least exact ones.
_MOST_BESIDE_VOXELS = 0.8, 0.4
_LEAST_WIDTH_VOXELS = 0.1, 0.2

# Patches that were hit a few times are narrow, and points beside them lie on the same surface. Up
# to the first mean width of a cloud's patches, voxels, distances are those from planes. From the
# second one on they are those of the map, which find poses twice as exactly in a house. Its width
# is 0.21 after the first frame of 77,000 points, and 0.23 to 0.26 in the end. In a room of 300
# points a frame it is 0.16 to 0.19.
_NARROW_VOXELS = 0.20
_WIDE_VOXELS = 0.22

# A return contradicts the map if it is this far inside observed space, and this far from patches.
_FREE_VOXELS = 0.5
_EMPTY_VOXELS = 1.5

# A surface faces away from the sensor if one voxel before it the ray is this deep in the solid.
_BACK_VOXELS = 0.5

# This many points of each ray are looked up. The last one is the first distance before the return.
# A point is in a solid if it is the second distance behind a surface. One voxel nearer to the
# sensor the signed distance is larger, by less than the third, unless the ray comes from behind.
_RAY_POINTS = 32
_BEFORE_VOXELS = 1.5
_SOLID_VOXELS = 1.0
_FRONT_VOXELS = 2.0

# The error of trilinear interpolation near surfaces, as a share of the samples' spacing.
_BAKED_SPREAD = 0.05


class Match(NamedTuple):
    """Points compared with a map.

    Attributes:
        distance: Signed distance from the surface, (N,) m.
        normal: Its gradient, (N, 3).
        spread: Standard deviation of the surface there, (N,) m.
        depth: How far the point lies in unseen space, (N,) m; negative in observed space.
        usable: The map has a surface near the point, (N,) bool.
        empty: The map has seen the place, and no surface there, (N,) bool.
    """

    distance: jax.Array
    normal: jax.Array
    spread: jax.Array
    depth: jax.Array
    usable: jax.Array
    empty: jax.Array


def match_points(
    field: Field | Baked,
    points_world: jax.Array,
    offset: jax.Array,
    some: jax.Array,
    growing: jax.Array | float,
) -> Match:
    """Compares points with a map.

    A live map answers by its grid alone: the network changes no surface and costs more.

    Args:
        field: The map.
        points_world: (N, 3) m, finite.
        offset: The same relative to the sensor, (N, 3) m.
        some: The row is a point, (N,) bool.
        growing: How incomplete the map is, () from 0 to 1.

    Returns:
        The comparison. Differentiable by the points.
    """
    if isinstance(field, Baked):
        answer = query(field, points_world)
        distance, normal, depth = answer.sdf, answer.grad, -answer.frontier
        spread = jnp.full(distance.shape, _BAKED_SPREAD) * field.resolution
        # `bake` takes half a cell's diagonal off the frontier.
        depth = depth - 3**0.5 / 2 * field.resolution
        inside = jnp.ones(distance.shape, bool)
        empty = jnp.zeros(distance.shape, bool)  # all points are usable
    else:
        config, surface = field.config, field.surface

        def nearest(points: jax.Array) -> tuple[jax.Array, jax.Array]:
            found = lookup.nearest_patch(config, surface, points)
            return found.sdf, found.spread

        distance, pull, spread = jax.vjp(nearest, points_world, has_aux=True)
        (normal,) = pull(jnp.ones_like(distance))
        plane = lookup.nearest_plane(config, surface, points_world)
        depth = -lookup.frontier_distance(config, surface, geometry.clamp(config, points_world))
        inside = jnp.all(points_world == geometry.clamp(config, points_world), axis=-1)
        free = depth < -_FREE_VOXELS * config.voxel_size
        empty = inside & free & (plane.away > _EMPTY_VOXELS * config.voxel_size)
        beside, width = plane.beside / config.voxel_size, plane.width / config.voxel_size
        inside &= (beside < _MOST_BESIDE_VOXELS[0]) & (width > _LEAST_WIDTH_VOXELS[0])
        share = _share_of_map(width, some & inside)
        # Where most patches are narrow, none can be left out.
        strict = share * growing
        inside &= beside < between(_MOST_BESIDE_VOXELS, strict)
        inside &= width > between(_LEAST_WIDTH_VOXELS, strict)
        # A sheet's distance grows on both sides, the height above its plane on one.
        side = jnp.where(jnp.sum(normal * plane.normal, axis=-1) < 0, -1, 1)
        distance = share * distance + (1 - share) * side * plane.height
        normal = share * normal + (1 - share) * side[:, None] * plane.normal
        spread = share * spread + (1 - share) * plane.spread
        inside &= ~_is_back(field, points_world, offset, normal)
    steep = jnp.sum(normal**2, axis=-1) > _LEAST_SLOPE**2
    return Match(distance, normal, spread, depth, inside & steep, empty)


def _is_back(
    field: Field, points_world: jax.Array, offset: jax.Array, normal: jax.Array
) -> jax.Array:
    """Returns a mask of points whose nearest surface faces away from the sensor, (N,) bool.

    A wall that was seen from the next room alone would hold the returns from its other side. Sheets
    whose two sides are free have a front for every sensor.
    """
    size = field.config.voxel_size
    away = jnp.sum(offset**2, axis=-1, keepdims=True)
    before = points_world - size * offset * jax.lax.rsqrt(jnp.maximum(away, 1e-6))
    behind = _voxel_sdf(field, before) < -_BACK_VOXELS * size
    return behind & (jnp.sum(normal * offset, axis=-1) > 0)


def find_blocked(
    field: Field | Baked, pose: jax.Array, points: jax.Array, some: jax.Array
) -> jax.Array:
    """Finds the returns whose rays would have entered a solid that the map knows.

    Args:
        field: The map. A baked field does not tell solids from unseen space: it blocks no ray.
        pose: (4, 4) T_world_sensor.
        points: (N, 3) m, sensor frame, finite.
        some: The row is a return, (N,) bool.

    Returns:
        (N,) bool.
    """
    if isinstance(field, Baked):
        return jnp.zeros_like(some)
    voxel_size = field.config.voxel_size
    offset = offsets_from(pose, points)
    distance = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1), 1e-12))
    reach = jnp.maximum(1 - _BEFORE_VOXELS * voxel_size / distance, 0)
    share = (jnp.arange(_RAY_POINTS, dtype=jnp.float32) + 0.5) / _RAY_POINTS * reach[:, None]
    points_world = pose[:3, 3] + offset[:, None] * share[..., None]
    before = points_world - voxel_size * (offset / distance[:, None])[:, None]
    here, there = (_voxel_sdf(field, points) for points in (points_world, before))
    # The ray must come from the front. Behind walls that were seen from one side, solids are a
    # guess, and a sensor in the next room sees the wall from there.
    enters = (there > here) & (there < here + _FRONT_VOXELS * voxel_size)
    solid = enters & (here < -_SOLID_VOXELS * voxel_size)
    return some & jnp.any(solid, axis=-1)


def _voxel_sdf(field: Field, points_world: jax.Array) -> jax.Array:
    """The signed distances of the voxels that contain points, (...) m; inf outside the bounds.

    The patches would be more exact, but hypotheses under vmap would need 7 times the memory.
    """
    index, _, inside = geometry.voxel_of(field.config, points_world)
    row = geometry.flat_index(field.config.grid_shape, split(index))
    sdf = field.surface.derived.sdf.ravel()[row].astype(jnp.float32)
    return jnp.where(inside, sdf, jnp.inf)


def _share_of_map(width: jax.Array, usable: jax.Array) -> jax.Array:
    """How far distances are the map's own, not those from planes: from 0 to 1, for all points."""
    total = jnp.sum(jnp.where(usable, jax.lax.stop_gradient(width), 0))
    mean = total / jnp.maximum(jnp.sum(usable), 1)
    return jnp.clip((mean - _NARROW_VOXELS) / (_WIDE_VOXELS - _NARROW_VOXELS), 0, 1)


def between(limits: tuple[float, float], share: jax.Array | float) -> jax.Array | float:
    """Returns the first limit at a share of 0, the second one at 1, and a mean in between."""
    return limits[0] + share * (limits[1] - limits[0])


def noise_of(field: Field | Baked) -> tuple[float, float]:
    """Returns (a, b) of the standard deviation a + b r^2 of a return, m and 1/m.

    It is that of the map's configuration. A baked field has none, and gets the default.
    """
    if isinstance(field, Field):
        return field.config.range_noise
    return Config.range_noise
