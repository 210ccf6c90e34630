"""What a planner asks the map: distances, gradients, and whether it has seen a place."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax.config import Config
from hiosdf_jax.grid import geometry, lookup
from hiosdf_jax.network import siren
from hiosdf_jax.state import Field, MapState, Query


def sdf(field: MapState | Field, points: Any) -> jax.Array:
    """Signed distance to the nearest surface, by the network.

    Outside the bounds it is the distance to the box plus the value at the box's nearest point.

    Args:
        field: A map or a snapshot of one.
        points: (..., 3) m, world frame.

    Returns:
        (...) float32, m; positive in free space, negative behind surfaces. Differentiable.

    Raises:
        ValueError: An argument is not what it should be.
    """
    config, params, origin_world = _network_of(field)
    return _sdf(config, params, origin_world, _checked(points))


def sdf_and_grad(field: MapState | Field, points: Any) -> tuple[jax.Array, jax.Array]:
    """Signed distance and its gradient, by one backward pass for the whole batch.

    Args:
        field: A map or a snapshot of one.
        points: (..., 3) m, world frame.

    Returns:
        The distance (...) float32, m, and d(sdf)/d(point), (..., 3) float32. Differentiable.

    Raises:
        ValueError: An argument is not what it should be.
    """
    config, params, origin_world = _network_of(field)
    value, pull = jax.vjp(lambda x: _sdf(config, params, origin_world, x), _checked(points))
    return value, pull(jnp.ones_like(value))[0]


def query(field: MapState | Field, points: Any) -> Query:
    """Signed distance, its gradient, and whether the place has been seen.

    Args:
        field: A map or a snapshot of one.
        points: (..., 3) m, world frame.

    Returns:
        The answer; points outside the bounds are not observed.

    Raises:
        ValueError: An argument is not what it should be.
    """
    points = _checked(points)
    value, gradient = sdf_and_grad(field, points)
    seen = field.observed if isinstance(field, Field) else lookup.observed(field.grid)
    index, _, inside = geometry.voxel_of(field.config, points)
    flat = geometry.flat_index(field.config.grid_shape, index)
    return Query(value, gradient, seen.ravel()[flat] & inside)


def _sdf(config: Config, params: Any, origin_world: jax.Array, points: jax.Array) -> jax.Array:
    nearest = geometry.clamp(config, points)
    beyond = points - nearest
    # Scaled by the largest component, since the square of a far point would overflow.
    scale = jnp.maximum(jnp.max(jnp.abs(jax.lax.stop_gradient(beyond)), axis=-1), 1e-6)
    square = jnp.sum((beyond / scale[..., None]) ** 2, axis=-1)
    outside = square > 0
    distance = jnp.where(outside, scale * jnp.sqrt(jnp.where(outside, square, 1)), 0)
    return siren.predict(config, params, nearest - origin_world) + distance


def _network_of(field: MapState | Field) -> tuple[Config, Any, jax.Array]:
    if isinstance(field, MapState):
        return field.config, field.network.served, field.network.origin_world
    if isinstance(field, Field):
        return field.config, field.params, field.origin_world
    raise ValueError(f"field is {type(field).__name__}, expected a MapState or a Field")


def _checked(points: Any) -> jax.Array:
    points = jnp.asarray(points)
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points has shape {points.shape}, expected (..., 3)")
    # Infinite points are taken as very far ones: inf - inf would be NaN.
    limit = 1e30
    return jnp.clip(points.astype(jnp.float32), -limit, limit)
