"""The grid's own answer at any point: the nearest of the patches that the voxels around know.

Evaluating patches at the point itself has no interpolation error; trilinear interpolation of the
signed distances at the voxels' centres gives the sign.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax.config import Config
from hiosdf_jax.grid import geometry, surface
from hiosdf_jax.grid.distance import NO_FEATURE
from hiosdf_jax.state import Grid


def observed(grid: Grid) -> jax.Array:
    """Tells the voxels that a ray has reached.

    Args:
        grid: The grid.

    Returns:
        (X, Y, Z) bool.
    """
    return (grid.passes > 0) | (grid.hits > 0)


def interpolate(config: Config, values: jax.Array, points_world: jax.Array) -> jax.Array:
    """Interpolates values at the voxels' centres trilinearly.

    Args:
        config: The map's configuration.
        values: (X, Y, Z).
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        (...).
    """
    corners = geometry.corners_of(config, geometry.clamp(config, points_world))
    flat = geometry.flat_index(config.grid_shape, corners.index)
    return jnp.sum(values.ravel()[flat] * corners.weight, axis=-1)


def grid_sdf(config: Config, grid: Grid, points_world: jax.Array) -> jax.Array:
    """Signed distance by the grid alone.

    Args:
        config: The map's configuration.
        grid: The grid.
        points_world: (..., 3) m; points outside the bounds take the border's value.

    Returns:
        (...) m; the horizon where there is no feature within it. Differentiable by the points.
    """
    shape = config.grid_shape
    points_world = geometry.clamp(config, points_world)
    corners = geometry.corners_of(config, points_world)
    flat = geometry.flat_index(shape, corners.index)
    jump = grid.nearest.reshape(-1, 3)[flat].astype(jnp.int32)
    known = jump[..., 0] != NO_FEATURE
    site = jnp.where(known[..., None], corners.index + jump, 0)
    row = geometry.flat_index(shape, site)
    mean = grid.mean.reshape(-1, 3)[row].astype(jnp.float32)
    axes = grid.axes.reshape(-1, 3, 3)[row].astype(jnp.float32)
    # Both from the same voxel's centre, so that large coordinates lose no digits.
    first = corners.index[..., :1, :]
    first_world = geometry.voxel_center(config, first)
    point = (points_world[..., None, :] - first_world) / config.voxel_size
    offset = surface.patch_offset(point, mean + (site - first), axes)
    distance = jnp.min(jnp.where(known, surface.safe_norm(offset), jnp.inf), axis=-1)
    side = jnp.sum(grid.sdf.ravel()[flat] * corners.weight, axis=-1)
    metres = jnp.where(jnp.any(known, axis=-1), distance, 0) * config.voxel_size
    return jnp.where(
        jnp.any(known, axis=-1), jnp.where(side < 0, -metres, metres), config.distance_horizon
    )


def grid_sdf_and_grad(
    config: Config, grid: Grid, points_world: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Signed distance by the grid alone, and its gradient.

    Args:
        config: The map's configuration.
        grid: The grid.
        points_world: (..., 3) m.

    Returns:
        The distance (...) m and its gradient (..., 3).
    """
    value, pull = jax.vjp(lambda points: grid_sdf(config, grid, points), points_world)
    return value, pull(jnp.ones_like(value))[0]
