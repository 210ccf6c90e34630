"""The grid's own answer at any point: the nearest of the patches that the voxels around know.

Evaluating patches at the point itself has no interpolation error; trilinear interpolation of the
signed distances at the voxels' centres gives the sign.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.distance import NO_FEATURE
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.numerics.vectors import Vector, dot, each, join, length, split, take
from hiosdf_jax._src.state import Surface

# A voxel is seen or not, even where the distance between the two is 0, m.
_LEAST_FRONTIER = 1e-6


class Nearest(NamedTuple):
    """What the grid says of points.

    Attributes:
        sdf: (...) m, signed distance to the nearest patch; the horizon where none is within it.
        spread: (...) m, standard deviation of that patch's hits along its normal; 0 without one.
    """

    sdf: jax.Array
    spread: jax.Array


def observed(passes: jax.Array, hits: jax.Array) -> jax.Array:
    """Tells the voxels that a ray has reached.

    Args:
        passes: (...) rays that went through the voxel.
        hits: (...) rays that ended in it.

    Returns:
        (...) bool.
    """
    return (passes > 0) | (hits > 0)


def nearest_patch(config: Config, known: Surface, points_world: jax.Array) -> Nearest:
    """Finds the nearest patch among those that the eight voxels around a point know.

    Args:
        config: The map's configuration.
        known: The grid's surface.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        The answer; its distance is differentiable by the points.
    """
    shape = config.grid_shape
    points_world = geometry.clamp(config, points_world)
    corners = geometry.corners_of(config, points_world)
    jump = take(known.nearest.reshape(-1, 3), corners.flat)
    found = corners.inside & (jump[0] != NO_FEATURE)
    # Both from the same voxel's centre, so that large coordinates lose no digits.
    first = each(lambda i: i[..., 0], corners.index)
    first_world = geometry.voxel_center(config, join(first))
    point = split((points_world - first_world) / config.voxel_size)
    means, axes = known.mean.reshape(-1, 3), known.axes.reshape(-1, 9)

    def offset_from(site: Vector, point: Vector, first: Vector) -> tuple[Vector, jax.Array]:
        """Vector to points from the patches of voxels, and which voxels these are."""
        row = geometry.flat_index(shape, site)
        mean = each(lambda m, s, f: m + (s - f), take(means, row), site, first)
        spans = (take(axes, row), take(axes, row, 3))
        return patches.patch_offset(point, mean, spans), row

    # The nearest of eight first, then the distance to that one alone: only it has a derivative.
    sites = each(lambda i, j: jnp.where(found, i + j, 0), corners.index, jump)
    offset, _ = offset_from(sites, *(each(lambda a: a[..., None], v) for v in (point, first)))
    squared = jnp.where(found, dot(offset, offset), jnp.inf)
    closest = jnp.argmin(squared, axis=-1)[..., None]
    site = each(lambda s: jnp.take_along_axis(s, closest, axis=-1)[..., 0], sites)
    offset, row = offset_from(site, point, first)
    any_found = jnp.any(found, axis=-1)
    metres = jnp.where(any_found, length(offset), 0) * config.voxel_size
    # Voxels without a feature have no side: those that `grow` adds must not change old answers.
    signed = known.sdf.ravel()[corners.flat].astype(jnp.float32)
    side = jnp.sum(jnp.where(found, signed * corners.weight, 0), axis=-1)
    spread = jnp.where(any_found, length(take(axes, row, 6)) * config.voxel_size, 0)
    return Nearest(
        jnp.where(any_found, jnp.where(side < 0, -metres, metres), config.distance_horizon),
        jax.lax.stop_gradient(spread),
    )


def grid_sdf(config: Config, known: Surface, points_world: jax.Array) -> jax.Array:
    """Signed distance by the grid alone.

    Args:
        config: The map's configuration.
        known: The grid's surface.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        (...) m; the horizon where there is no feature within it. Differentiable by the points.
    """
    return nearest_patch(config, known, points_world).sdf


def grid_sdf_and_grad(
    config: Config, known: Surface, points_world: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance by the grid alone, and its gradient.

    Args:
        config: The map's configuration.
        known: The grid's surface.
        points_world: (..., 3) m.

    Returns:
        The distance (...) m and its gradient (..., 3).
    """
    return value_and_gradient(lambda points: grid_sdf(config, known, points), points_world)


def doubt(config: Config, known: Surface, points_world: jax.Array) -> jax.Array:
    """Distance to anything that may be a surface, interpolated trilinearly between voxels' centres.

    Args:
        config: The map's configuration.
        known: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m. Differentiable.
    """
    corners = geometry.corners_of(config, points_world)
    metres = known.doubt.ravel()[corners.flat].astype(jnp.float32)
    # Beyond the bounds: what the voxels have that `grow` adds, so that it changes no old answer.
    metres = jnp.where(corners.inside, metres, config.distance_horizon)
    return jnp.sum(metres * corners.weight, axis=-1)


def frontier(config: Config, known: Surface, points_world: jax.Array) -> jax.Array:
    """Distance to the nearest unseen voxel, interpolated trilinearly between voxels' centres.

    Args:
        config: The map's configuration.
        known: The grid's surface.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m; positive in voxels that were seen, negative in others. Differentiable.
    """
    corners = geometry.corners_of(config, points_world)
    steps = known.frontier.ravel()
    around = steps[corners.flat].astype(jnp.float32) * geometry.frontier_step_m(config)
    around = jnp.where(corners.inside, around, -config.frontier_horizon)
    index, _, inside = geometry.voxel_of(config, points_world)
    seen = inside & (steps[geometry.flat_index(config.grid_shape, split(index))] > 0)
    # Beyond the bounds, and after `grow` until the next update, voxels know nothing. Next to a seen
    # voxel the unseen space begins half a voxel before the unseen one's centre; elsewhere they are
    # taken to be as deep in it as the deepest that knows.
    ignorant = around <= -0.999 * config.frontier_horizon
    deepest = jnp.min(jnp.where(ignorant, jnp.inf, around), axis=-1)
    deepest = jnp.where(jnp.isfinite(deepest), deepest, -config.frontier_horizon)
    filled = jnp.where(ignorant, jnp.minimum(deepest, 0)[..., None], around)
    around = jnp.where(seen[..., None], jnp.maximum(around, -0.5 * config.voxel_size), filled)
    between = jnp.sum(around * corners.weight, axis=-1)
    signed = jnp.where(
        seen, jnp.maximum(between, _LEAST_FRONTIER), jnp.minimum(between, -_LEAST_FRONTIER)
    )
    # The sign is certain, but a planner still needs the slope.
    return between + jax.lax.stop_gradient(signed - between)
