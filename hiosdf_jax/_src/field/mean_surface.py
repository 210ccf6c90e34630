"""The mean surface of parallel patches, to which the mesh is moved."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.numerics.vectors import dot, each, join, split, unit
from hiosdf_jax._src.state.pytrees import Surface

# The mean surface is that of patches up to the first distance, voxels, with normals up to about 45
# degrees off. The weight falls by 1 / e for each of the second distance.
_MOVED_VOXELS = 0.5
_MOVED_COSINE = 0.7
_MOVED_SOFT_VOXELS = 0.3


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
    patch = lookup.patches_at(config, surface, corners, point)
    cosine = dot(patch.normal, each(lambda n: n[None], split(normals)))
    near = patch.found & (patch.distance < _MOVED_VOXELS) & (jnp.abs(cosine) > _MOVED_COSINE)
    nearness = jnp.exp(-patch.distance / _MOVED_SOFT_VOXELS)
    weight = jnp.where(near, corners.weight * nearness * patch.area, 0)
    total = jnp.sum(weight, axis=0)
    share = weight / jnp.maximum(total, lookup.LEAST_WEIGHT)
    signed = share * jnp.sign(cosine)
    height_m = jnp.sum(signed * patch.height, axis=0) * config.voxel_size
    normal = join(unit(each(lambda n: jnp.sum(signed * n, axis=0), patch.normal)))
    some = (total > lookup.LEAST_WEIGHT)[..., None]
    return OnSurface(
        jnp.where(some, points_world - height_m[..., None] * normal, points_world),
        jnp.where(some, normal, normals),
        jnp.sum(share * patch.spread, axis=0) * config.voxel_size,
    )
