"""What a planner asks the map: distances, gradients, and how far what it has seen reaches."""

from __future__ import annotations

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field import blend, lattice
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.mapping import calibration
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.state import Baked, Field, MapState, Query

_FAR = 1e30  # m

AnyField = MapState | Field | Baked
Unknown = Literal["network", "obstacle"]


def sdf(field: AnyField, points: Any, unknown: Unknown = "network") -> jax.Array:
    """Signed distance to the nearest surface.

    Outside the bounds it is the distance to the box plus the value at the box's nearest point; for
    a point with a NaN it is -1e30, so that a rollout that has diverged is not taken for safe.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        points: (..., 3) m, world frame.
        unknown: What to make of space that no ray has reached: "network", whatever the map
            predicts there; "obstacle", a solid body: the least of the distances to surfaces and
            to unseen space.

    Returns:
        (...) float32, m; positive in free space, negative behind surfaces. Differentiable.

    Raises:
        ValueError: An argument is not what it should be.
    """
    return _distance(as_field(field), _checked(points, unknown), unknown)


def sdf_and_grad(
    field: AnyField, points: Any, unknown: Unknown = "network"
) -> tuple[jax.Array, jax.Array]:
    """Signed distance and its gradient, by one backward pass for the whole batch.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        points: (..., 3) m, world frame.
        unknown: As for `sdf`.

    Returns:
        The distance (...) float32, m, and d(sdf)/d(point), (..., 3) float32. Differentiable.

    Raises:
        ValueError: An argument is not what it should be.
    """
    return _distance_and_grad(as_field(field), _checked(points, unknown), unknown)


def query(field: AnyField, points: Any, unknown: Unknown = "network") -> Query:
    """All that the map knows of points.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        points: (..., 3) m, world frame.
        unknown: As for `sdf`; it changes `sdf` and `grad` of the answer alone.

    Returns:
        The answer. Points outside the bounds are not observed.

    Raises:
        ValueError: An argument is not what it should be.
    """
    return _query(as_field(field), _checked(points, unknown), unknown)


def as_field(field: AnyField) -> Field | Baked:
    """Takes what queries read out of a map, without a copy.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.

    Returns:
        A field, or the baked snapshot itself.

    Raises:
        ValueError: It is something else.
    """
    if isinstance(field, Field | Baked):
        return field
    if isinstance(field, MapState):
        return field_of(field)
    raise ValueError(f"field is {type(field).__name__}, expected a MapState, a Field or a Baked")


def field_of(state: MapState) -> Field:
    """What queries read out of a map, without a copy."""
    return Field(
        config=state.config,
        params=state.network.served,
        origin_world=state.network.origin_world,
        surface=state.grid.surface,
        optimism=state.optimism,
        updates=state.updates,
        stamp=jnp.zeros((), jnp.float32),
    )


# Compiled by themselves, so that a call outside jit is one dispatch.
_compiled = functools.partial(jax.jit, static_argnames="unknown")


@_compiled
def _query(field: Field | Baked, points: jax.Array, unknown: Unknown) -> Query:
    value, gradient = _distance_and_grad(field, points, unknown)
    frontier = _frontier(field, points)
    inside, beyond = _split(field, points)
    if isinstance(field, Baked):
        lower = lattice.interpolate(field, field.lower, inside)
    else:
        lower = calibration.lower_bound(field, inside)
    return Query(value, gradient, frontier > 0, frontier, lower - beyond)


@_compiled
def _distance_and_grad(
    field: Field | Baked, points: jax.Array, unknown: Unknown
) -> tuple[jax.Array, jax.Array]:
    return value_and_gradient(lambda points: _distance(field, points, unknown), points)


@_compiled
def _distance(field: Field | Baked, points: jax.Array, unknown: Unknown) -> jax.Array:
    inside, beyond = _split(field, points)
    if isinstance(field, Baked):
        value = lattice.interpolate(field, field.sdf, inside)
    else:
        value = blend.served_sdf(field, inside)
    # A point that is no point is nowhere safe: as deep inside as others are far outside.
    nowhere = jnp.any(jnp.isnan(points), axis=-1)
    value = value + jnp.where(nowhere, -beyond, beyond)
    return value if unknown == "network" else jnp.minimum(value, _frontier(field, points))


def _frontier(field: Field | Baked, points: jax.Array) -> jax.Array:
    inside, beyond = _split(field, points)
    if isinstance(field, Baked):
        value = lattice.interpolate(field, field.frontier, inside)
    else:
        value = lookup.frontier(field.config, field.surface, inside)
    # Nothing outside the bounds has been seen, and the bounds themselves are the last of what has.
    return jnp.where(beyond > 0, jnp.minimum(value, 0) - beyond, value)


def _split(field: Field | Baked, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The nearest points of the box, (..., 3) m, and the distances to it, (...) m."""
    low, high = lattice.bounds(field) if isinstance(field, Baked) else field.config.bounds
    low, high = jnp.asarray(low, points.dtype), jnp.asarray(high, points.dtype)
    points = jnp.where(jnp.isnan(points), _FAR, points)
    nearest = geometry.clip_to_box(points, low, high)
    beyond = points - nearest
    # Scaled by the largest component, since the square of a far point would overflow.
    scale = jnp.maximum(jnp.max(jnp.abs(jax.lax.stop_gradient(beyond)), axis=-1), 1e-6)
    square = jnp.sum((beyond / scale[..., None]) ** 2, axis=-1)
    outside = square > 0
    return nearest, jnp.where(outside, scale * jnp.sqrt(jnp.where(outside, square, 1)), 0)


def _checked(points: Any, unknown: Any) -> jax.Array:
    if unknown not in ("network", "obstacle"):
        raise ValueError(f"unknown is {unknown!r}, expected 'network' or 'obstacle'")
    points = jnp.asarray(points)
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points has shape {points.shape}, expected (..., 3)")
    # Infinite points are taken as very far ones: inf - inf would be NaN.
    return jnp.clip(points.astype(jnp.float32), -_FAR, _FAR)
