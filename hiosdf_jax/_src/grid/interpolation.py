"""The distances to doubtful surfaces and to unseen space, interpolated between voxel centers."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.numerics.point_kernel import by_points
from hiosdf_jax._src.numerics.vectors import Vector
from hiosdf_jax._src.state.pytrees import Surface, frontier_step_m

# A voxel is either observed or not, even where its distance to the frontier is 0, m.
_LEAST_FRONTIER = 1e-6


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
