"""The mean plane of the patches near points, to which registration moves returns."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, length, unit
from hiosdf_jax._src.state.pytrees import Surface

# Patches count by 1 / e less for each of the first distance, and up to about 45
# degrees off.
_PLANE_VOXELS = 0.5
_PLANE_COSINE = 0.7


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
    patch = lookup.patches_at(config, surface, corners, point)
    away = jnp.where(patch.found, patch.distance, jnp.inf)
    number = jax.lax.broadcasted_iota(jnp.int32, away.shape, 0)
    nearest = number == jnp.argmin(away, axis=0)[None]
    nearest_normal = each(lambda n: jnp.sum(jnp.where(nearest, n, 0), axis=0), patch.normal)
    along = dot(patch.normal, each(lambda n: n[None], nearest_normal))
    nearness = jnp.exp(jnp.minimum(jnp.min(away, axis=0) - patch.distance, 0) / _PLANE_VOXELS)
    weight = jnp.maximum(corners.weight, lookup.LEAST_WEIGHT) * nearness * patch.area
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
