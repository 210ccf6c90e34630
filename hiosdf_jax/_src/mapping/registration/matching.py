"""What the map says of the returns of a cloud: distance, normal, spread, observed or not.

What is named `at` takes and returns vectors as three arrays, so that one kernel can compute it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.queries import query
from hiosdf_jax._src.grid import geometry, interpolation, lookup
from hiosdf_jax._src.mapping.registration import planes
from hiosdf_jax._src.mapping.registration.motion import offsets_from
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, split
from hiosdf_jax._src.state.pytrees import Baked, Field, Surface

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

# Behind a surface the map's distance is not linear: near thin things it falls back to 0, and its
# gradient points anywhere. So the noise of far returns moves a pose. Heights above the mean plane
# are linear, and the noise averages out. In a complete map returns with a standard deviation above
# the first value, m, begin to take planes, and above the second one take nothing else. Of 315 poses
# of 105 held-out frames in a house, 95 % are then off by at most 0.88 instead of 1.55 cm, and the
# mean normalized square fell from 42 to 9.5. If all but the nearest returns take planes (0.5 to
# 1.5 cm) the median rises from 0.27 to 0.37 cm. In a map that grows the planes made tracking worse:
# without odometry, the error of an apartment's map rose from 1.0 to 1.2 cm.
_EXACT_M = 0.01
_NOISY_M = 0.04

# A return contradicts the map if it is this far inside observed space, and this far from patches.
_FREE_VOXELS = 0.5
_EMPTY_VOXELS = 1.5

# A surface faces away from the sensor if one voxel before it the ray is this deep in the solid.
_BACK_VOXELS = 0.5

# A return from the other side of a surface without solid voxels behind it lies off its patches by
# the thickness of the thing, such as a tabletop. That is anything up to a voxel; here its standard
# deviation. Without it the 95 % error of poses in the house is 1.1 instead of 0.8 cm.
# In a map that grows, the side that the sensor sees may be missing. Where `Rows.growing` exceeds
# the second value, such returns are left out: they would pull a cloud through a wall by its
# thickness.
_THICKNESS_VOXELS = 12**-0.5
_GROWS = 0.5

# This many points of each ray are looked up. The last one is the first distance before the return.
# A point is in a solid if it is the second distance behind a surface. The ray must have entered it
# there: from point to point the signed distance falls by at most their spacing, and the third more
# between voxels that share an edge. With 32 points and one voxel, fewer rays of wrong poses are
# blocked, and more of right ones.
_RAY_POINTS = 64
_BEFORE_VOXELS = 1.5
_SOLID_VOXELS = 1.0
_JUMP_VOXELS = 2**0.5

# The error of trilinear interpolation near surfaces, as a share of the samples' spacing.
_BAKED_SPREAD = 0.05


class Match(NamedTuple):
    """Points compared with a map.

    Attributes:
        distance: Signed distance from the surface, (...) m.
        normal: Its gradient, (...) each.
        spread: Standard deviation of the surface there, (...) m.
        depth: How far the point lies in unseen space, (...) m; negative in observed space.
        usable: The map has a surface near the point, (...) bool.
        empty: The map has seen the place, and no surface there, (...) bool.
        width: Width of the patches near the point, (...) voxels; 0 where there is none to compare,
            and for a baked field.
    """

    distance: jax.Array
    normal: Vector
    spread: jax.Array
    depth: jax.Array
    usable: jax.Array
    empty: jax.Array
    width: jax.Array


def match_at(
    config: Config,
    surface: Surface,
    point_world: Vector,
    offset: Vector,
    growing: jax.Array,
    share: jax.Array,
    sigma: jax.Array,
) -> Match:
    """Compares points with a map by its grid alone: the network changes no surface and costs more.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        point_world: (...) m each, finite.
        offset: The same relative to the sensor, (...) m each.
        growing: How incomplete the map is, from 0 to 1.
        share: How far distances are the map's own; see `share_of_map`.
        sigma: Standard deviation of the range, (...) m.

    Returns:
        The comparison. Differentiable by the points.
    """

    def nearest_at(point: Vector) -> tuple[jax.Array, lookup.Nearest]:
        nearest = lookup.nearest_patch_at(config, surface, point, side_point=point_world)
        return nearest.sdf, nearest

    size = config.voxel_size
    _, pull, nearest = jax.vjp(nearest_at, point_world, has_aux=True)
    (own_normal,) = pull(jnp.ones_like(nearest.sdf))
    plane = planes.nearest_plane_at(config, surface, point_world)
    clamped = geometry.clamp(config, point_world)
    depth = -interpolation.frontier_at(config, surface, clamped)
    x, y, z = each(jnp.equal, point_world, clamped)
    inside = x & y & z
    empty = inside & (depth < -_FREE_VOXELS * size) & (plane.away > _EMPTY_VOXELS * size)

    beside, width = plane.beside / size, plane.width / size
    usable = inside & (beside < _MOST_BESIDE_VOXELS[0]) & (width > _LEAST_WIDTH_VOXELS[0])
    known = jnp.where(usable, jax.lax.stop_gradient(width), 0)
    # Where most patches are narrow, none can be left out.
    strict = share * growing
    usable &= beside < between(_MOST_BESIDE_VOXELS, strict)
    usable &= width > between(_LEAST_WIDTH_VOXELS, strict)

    noisy = jnp.clip((sigma - _EXACT_M) / (_NOISY_M - _EXACT_M), 0, 1) * (1 - growing)
    # A sheet's distance grows on both sides, the height above its plane on one.
    side = jnp.where(dot(own_normal, plane.normal) < 0, -1, 1)
    own = share * (1 - noisy)
    distance = own * nearest.sdf + (1 - own) * side * plane.height
    normal = each(lambda n, p: own * n + (1 - own) * side * p, own_normal, plane.normal)
    spread = own * nearest.spread + (1 - own) * plane.spread
    other_side = dot(plane.normal, offset) > 0
    spread = jnp.where(other_side, jnp.sqrt(spread**2 + (_THICKNESS_VOXELS * size) ** 2), spread)
    usable &= ~(other_side & (growing > _GROWS))
    usable &= ~_is_back(config, surface, point_world, offset, normal)
    return Match(distance, normal, spread, depth, usable & _is_steep(normal), empty, known)


def match_baked(baked: Baked, point_world: Vector) -> Match:
    """Compares points, (...) m each, with a baked field, as `match_at` does with a live map."""
    answer = query(baked, join(point_world))
    normal = split(answer.grad)
    # `bake` takes half a cell's diagonal off the frontier.
    depth = -answer.frontier - 3**0.5 / 2 * baked.resolution
    none = jnp.zeros_like(depth)
    spread = none + _BAKED_SPREAD * baked.resolution
    empty = none > 0  # all points are usable
    return Match(answer.sdf, normal, spread, depth, _is_steep(normal), empty, none)


def _is_steep(normal: Vector) -> jax.Array:
    return dot(normal, normal) > _LEAST_SLOPE**2


def _is_back(
    config: Config, surface: Surface, point_world: Vector, offset: Vector, normal: Vector
) -> jax.Array:
    """Returns a mask of points whose nearest surface faces away from the sensor, (...) bool.

    A wall that was seen from the next room alone would hold the returns from its other side. Sheets
    whose two sides are free have a front for every sensor.
    """
    size = config.voxel_size
    scale = size * jax.lax.rsqrt(jnp.maximum(dot(offset, offset), 1e-6))
    before = each(lambda p, o: p - o * scale, point_world, offset)
    behind = _voxel_sdf(config, surface, before) < -_BACK_VOXELS * size
    return behind & (dot(normal, offset) > 0)


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
    sdf = _voxel_sdf(field.config, field.surface, split(points_world))
    most_fall = (distance * reach / _RAY_POINTS + _JUMP_VOXELS * voxel_size)[:, None]
    jumps = jnp.pad(sdf[:, :-1] > sdf[:, 1:] + most_fall, ((0, 0), (1, 0)))
    # Behind a wall that was seen from one side, the solid is a guess. A ray through a door or from
    # the next room gets into it beside the wall, where the signed distance jumps. The last event
    # before a point is odd in front of a surface, and even at a jump or if there was none. Places
    # outside the bounds are infinitely far in front.
    number = 2 * jnp.arange(_RAY_POINTS)
    event = jnp.where(sdf > 0, number + 1, jnp.where(jumps, number, 0))
    entered = jax.lax.cummax(event, axis=1) % 2 == 1
    solid = entered & (sdf < -_SOLID_VOXELS * voxel_size)
    return some & jnp.any(solid, axis=-1)


def _voxel_sdf(config: Config, surface: Surface, point: Vector) -> jax.Array:
    """The signed distances of the voxels that contain points, (...) m; inf outside the bounds.

    The patches would be more exact, but hypotheses under vmap would need 7 times the memory.
    """
    index, inside = geometry.voxel_around(config, point)
    row = geometry.flat_index(config.grid_shape, index)
    return jnp.where(inside, surface.derived.sdf.ravel()[row].astype(jnp.float32), jnp.inf)


def share_of_map(width: jax.Array, count: jax.Array) -> jax.Array:
    """Computes how far distances are the map's own, not those from planes.

    Args:
        width: Sum of `Match.width`, () voxels.
        count: Number of points that have a width, ().

    Returns:
        () from 0 to 1.
    """
    mean = width / jnp.maximum(count, 1)
    return jnp.clip((mean - _NARROW_VOXELS) / (_WIDE_VOXELS - _NARROW_VOXELS), 0, 1)


def between(limits: tuple[float, float], share: jax.Array | float) -> jax.Array | float:
    """Returns the first limit at a share of 0, the second one at 1, and a mean in between."""
    return limits[0] + share * (limits[1] - limits[0])


def noise_of(field: Field | Baked) -> tuple[float, float]:
    """Returns (a, b) of the standard deviation a + b r^2 of a return, m and 1/m."""
    return _config_of(field).range_noise


def least_range_of(field: Field | Baked) -> float:
    """Returns the least range of a return, m."""
    return _config_of(field).min_range


def _config_of(field: Field | Baked) -> Config | type[Config]:
    """Returns the map's configuration. A baked field has none, and gets the defaults."""
    return field.config if isinstance(field, Field) else Config
