"""The surface of a map as the zero level of a function: its patches, blended.

A partition of unity weights the planes of the patches around a point (Ohtake et al., Multi-level
Partition of Unity Implicits, SIGGRAPH 2003, section 3). The blend extends beyond the patches, so a
second function says where the surface ends.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.patch_rectangles import FILLING_VOXELS
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, length, split, unit
from hiosdf_jax._src.state.pytrees import Surface

# A patch's weight falls by 1 / e for each of these distances that it is farther than the nearest
# one, voxels. Half as much leaves more noise on walls, twice as much rounds off more edges.
_SOFT_VOXELS = 0.3

# This many standard deviations of a patch's hits along its normal count as distance from it. The
# patch of a voxel inside a wall, with stray hits of both sides, is thick and lies across.
_THICKNESS = 3.0

OPPOSITE_COSINE = -0.7
"""Patches whose normals have a smaller cosine face away from each other."""

SAME_SHEET_VOXELS = 0.2
"""Such patches lie on the same sheet if their planes are nearer than this, voxels.

Otherwise they are the two sides of a solid.
"""

# The surface extends beyond a patch by the first distance, voxels, and over gaps between two
# patches that are narrower than the second one. The patches lie on opposite sides of a point if the
# angle between the directions to them has at most minus this cosine.
_MARGIN_VOXELS = 0.05
_GAP_VOXELS = 0.6
_ACROSS = 0.7

# Farther from every patch, voxels, there is no surface.
_FARTHEST_VOXELS = 0.45

_NONE = 9.0  # voxels; farther than anything


class Level(NamedTuple):
    """The function whose zero level is the surface, at points: arrays of JAX or of numpy.

    Attributes:
        height: Above the surface on the sensor's side, (...) voxels.
        beyond: Distance beyond the end of the surface, (...) voxels; negative on the surface.
        normal: Of the blended planes, unit vectors, (..., 3).
        plane_normal: Of the nearest patch, unit vectors, (..., 3).
        plane_height: Above the plane of the nearest patch, (...) voxels.
        spread: Standard deviation of the patches' hits along their normals, (...) voxels.
    """

    height: Any
    beyond: Any
    normal: Any
    plane_normal: Any
    plane_height: Any
    spread: Any


def evaluate(config: Config, surface: Surface, points_world: jax.Array) -> Level:
    """Evaluates the surface's function from the patches that the eight voxels around know.

    Which side of the surface is positive follows the nearest patch. It changes within a sheet that
    the sensor saw from both sides.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m.

    Returns:
        The function. Where no patch is known, height is 1 and the point lies beyond the surface.
    """
    point = split(points_world)
    corners = geometry.corners_of(config, point)
    patch = lookup.patches_at(config, surface, corners, point)
    # Patches that fill their voxels count only where no others are known.
    flat = patch.found & (patch.spread < FILLING_VOXELS)
    patch = patch._replace(found=jnp.where(jnp.any(flat, axis=0), flat, patch.found))
    away = jnp.where(patch.found, patch.distance, _NONE)
    # A thick patch counts as farther away.
    rank = away + _THICKNESS * patch.spread
    nearest, lag = jnp.argmin(rank, axis=0), rank - jnp.min(rank, axis=0)

    def of_nearest(values: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, nearest[None], axis=0)[0]

    plane_normal, plane_height = each(of_nearest, patch.normal), of_nearest(patch.height)
    opposite = _dot_each(patch.normal, plane_normal) < OPPOSITE_COSINE
    apart = jnp.abs(plane_height - _dot_each(patch.offset, plane_normal))
    same_sheet = apart < SAME_SHEET_VOXELS
    sign = jnp.where(opposite, -1, 1)
    counts = patch.found & (same_sheet | ~opposite)
    weight = corners.weight * patch.area * jnp.exp(-lag / _SOFT_VOXELS)
    weight = jnp.where(counts, jnp.maximum(weight, lookup.LEAST_WEIGHT), 0)
    weight /= jnp.maximum(jnp.sum(weight, axis=0), lookup.LEAST_WEIGHT)
    height = jnp.sum(weight * sign * patch.height, axis=0)
    normal = unit(each(lambda n: jnp.sum(weight * sign * n, axis=0), patch.normal))

    # Where the patches are, seen along the surface.
    offset = each(lambda s: jnp.where(patch.found, patch.distance * s, 0), patch.slope)
    above = _dot_each(offset, normal)
    offset = each(lambda o, n: o - above * n, offset, normal)
    side, reach = each(of_nearest, offset), length(offset)
    beside = of_nearest(reach)
    across = _dot_each(offset, side) <= -_ACROSS * beside * reach
    gap = jnp.min(jnp.where(patch.found & across, beside + reach, _NONE), axis=0)
    beyond = jnp.minimum(beside - _MARGIN_VOXELS, gap - _GAP_VOXELS)
    least = jnp.min(away, axis=0)
    beyond = jnp.maximum(beyond, least - _FARTHEST_VOXELS)

    some = least < _NONE
    return Level(
        jnp.where(some, height, 1),
        jnp.where(some, beyond, _NONE),
        join(normal),
        join(plane_normal),
        plane_height,
        jnp.sum(weight * patch.spread, axis=0),
    )


def _dot_each(vectors: Vector, vector: Vector) -> jax.Array:
    """Computes the scalar products of (8, ...) vectors with one vector (...)."""
    return dot(vectors, each(lambda v: v[None], vector))
