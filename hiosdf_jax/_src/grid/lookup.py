"""The grid's answers at any point: nearest patch, doubt and frontier.

The patches that the eight surrounding voxels know are evaluated at the point itself, without
interpolation error. Trilinear interpolation of the voxels' signed distances gives the sign.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, length, split, take
from hiosdf_jax._src.state import NO_FEATURE, Surface, frontier_step_m

# A voxel is either observed or not, even where its distance to the frontier is 0, m.
_LEAST_FRONTIER = 1e-6


class Nearest(NamedTuple):
    """The nearest patch of points.

    Attributes:
        sdf: Signed distance to the patch, (...) m; the horizon where none is within it.
        spread: Standard deviation of the patch's hits along its normal, (...) m; 0 without one.
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
        The nearest patch; its distance is differentiable by the points.
    """
    shape = config.grid_shape
    points_world = geometry.clamp(config, points_world)
    corners = geometry.corners_of(config, points_world)
    jump = take(surface.derived.nearest.reshape(-1, 3), corners.flat)
    found = corners.inside & (jump[0] != NO_FEATURE)
    # Relative to one voxel's center, so that large coordinates lose no digits.
    first = each(lambda i: i[..., 0], corners.index)
    first_world = geometry.voxel_center(config, join(first))
    point = split((points_world - first_world) / config.voxel_size)
    means, axes = surface.mean.reshape(-1, 3), surface.axes.reshape(-1, 9)

    def offset_from(site: Vector, point: Vector, first: Vector) -> tuple[Vector, jax.Array]:
        """Computes vectors from the patches of voxels to points, and the voxels' rows."""
        row = geometry.flat_index(shape, site)
        mean = each(lambda m, s, f: m + (s - f), take(means, row), site, first)
        spans = (take(axes, row), take(axes, row, 3))
        return patches.patch_offset(point, mean, spans), row

    # First the nearest of eight, then the distance to that one: only this has a derivative.
    sites = each(lambda i, j: jnp.where(found, i + j, 0), corners.index, jump)
    offset, _ = offset_from(sites, *(each(lambda a: a[..., None], v) for v in (point, first)))
    squared = jnp.where(found, dot(offset, offset), jnp.inf)
    closest = jnp.argmin(squared, axis=-1)[..., None]
    site = each(lambda s: jnp.take_along_axis(s, closest, axis=-1)[..., 0], sites)
    offset, row = offset_from(site, point, first)
    any_found = jnp.any(found, axis=-1)
    distance_m = jnp.where(any_found, length(offset), 0) * config.voxel_size
    # Voxels without a patch have no side: voxels that `grow` adds must not change old answers.
    signed = surface.derived.sdf.ravel()[corners.flat].astype(jnp.float32)
    side = jnp.sum(jnp.where(found, signed * corners.weight, 0), axis=-1)
    spread = jnp.where(any_found, length(take(axes, row, 6)) * config.voxel_size, 0)
    signed_m = jnp.where(side < 0, -distance_m, distance_m)
    return Nearest(
        jnp.where(any_found, signed_m, config.distance_horizon), jax.lax.stop_gradient(spread)
    )


def grid_sdf(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the signed distance of the grid alone.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        (...) m; the horizon where no patch is within it. Differentiable by the points.
    """
    return nearest_patch(config, surface, points_world).sdf


def doubt_distance(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the distance to anything that may be a surface, interpolated between voxel centers.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m. Differentiable.
    """
    corners = geometry.corners_of(config, points_world)
    around = surface.derived.doubt.ravel()[corners.flat].astype(jnp.float32)
    # Beyond the bounds: the value of voxels that `grow` adds, so that it changes no old answer.
    around = jnp.where(corners.inside, around, config.distance_horizon)
    return jnp.sum(around * corners.weight, axis=-1)


def frontier_distance(config: Config, surface: Surface, points_world: jax.Array) -> jax.Array:
    """Computes the distance to the nearest unobserved voxel, interpolated between voxel centers.

    Args:
        config: The map's configuration.
        surface: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m; positive in observed voxels, negative in others. Differentiable.
    """
    corners = geometry.corners_of(config, points_world)
    steps = surface.derived.frontier_steps.ravel()
    around = steps[corners.flat].astype(jnp.float32) * frontier_step_m(config)
    around = jnp.where(corners.inside, around, -config.frontier_horizon)
    index, _, inside = geometry.voxel_of(config, points_world)
    observed = inside & (steps[geometry.flat_index(config.grid_shape, split(index))] > 0)
    # Voxels beyond the bounds know nothing, and voxels that `grow` added know nothing until the
    # next update. Next to an observed voxel, unseen space begins half a voxel before the unobserved
    # center. Elsewhere they count as deep as the deepest voxel that knows.
    ignorant = around <= -0.999 * config.frontier_horizon
    deepest = jnp.min(jnp.where(ignorant, jnp.inf, around), axis=-1)
    deepest = jnp.where(jnp.isfinite(deepest), deepest, -config.frontier_horizon)
    filled = jnp.where(ignorant, jnp.minimum(deepest, 0)[..., None], around)
    around = jnp.where(observed[..., None], jnp.maximum(around, -0.5 * config.voxel_size), filled)
    between = jnp.sum(around * corners.weight, axis=-1)
    signed = jnp.where(
        observed, jnp.maximum(between, _LEAST_FRONTIER), jnp.minimum(between, -_LEAST_FRONTIER)
    )
    # The sign is exact; the slope is that of the interpolation.
    return between + jax.lax.stop_gradient(signed - between)
