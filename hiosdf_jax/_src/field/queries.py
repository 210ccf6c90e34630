"""Queries at points: distances, gradients, the frontier and lower bounds."""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field import blend, lattice
from hiosdf_jax._src.grid.geometry import clip_to_box
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.numerics.intake import check_vectors
from hiosdf_jax._src.numerics.modes import pointwise
from hiosdf_jax._src.numerics.point_tiles import Evaluate, by_rows
from hiosdf_jax._src.state.checks import check_single
from hiosdf_jax._src.state.pytrees import Baked, Bound, Field, MapState, Query, Unknown, field_of

_FAR = 1e30  # m

# From this deep in unseen space on, m, only the distance to the frontier counts. Less makes a bump
# where the frontier takes over.
_DEEP_M = 0.4

_BATCHED = "jax.vmap, for example jax.vmap(hio.sdf, in_axes=(0, None))(fields, points)"

AnyField = MapState | Field | Baked


def sdf(field: AnyField, points: Any, unknown: Unknown = "network") -> jax.Array:
    """Computes the signed distance to the nearest surface.

    Outside the bounds it is the distance to the box plus the value at the box's nearest point. With
    unknown="obstacle", and outside a baked window, where a surface may be anywhere, the distance to
    the box is subtracted instead. NaN points return -1e30, i.e. in collision, so that a diverged
    rollout is never safe.

    Args:
        field: A map, a snapshot of one, or a baked field.
        points: (..., 3) m, world frame.
        unknown: Policy for unseen space. "network" returns the map's prediction there. "obstacle"
            treats unseen space as solid: the result is min(sdf, frontier) in observed space and,
            from 40 cm deep in unseen space on, the frontier's negative distance alone. Between
            them the grid's guess fades to the frontier.

    Returns:
        (...) float32, m; positive in free space, negative behind surfaces. Differentiable.

    Raises:
        ValueError: An argument has a wrong type, shape or value.

    Example:
        >>> clearance = hio.sdf(field, points, unknown="obstacle") - robot_radius
    """
    return distance(field, points, unknown, "sdf")


def sdf_and_grad(
    field: AnyField, points: Any, unknown: Unknown = "network"
) -> tuple[jax.Array, jax.Array]:
    """Computes the signed distance and its gradient by one reverse-mode evaluation of the batch.

    Args:
        field: A map, a snapshot of one, or a baked field.
        points: (..., 3) m, world frame.
        unknown: As for `sdf`.

    Returns:
        The distance (...) float32, m, and d(sdf)/d(point), (..., 3) float32. Differentiable.

    Raises:
        ValueError: An argument has a wrong type, shape or value.

    Example:
        >>> distance, gradient = hio.sdf_and_grad(field, points)
    """
    return distance_and_grad(field, points, unknown, "sdf")


def query(field: AnyField, points: Any, unknown: Unknown = "network") -> Query:
    """Computes everything that the map knows of points.

    Args:
        field: A map, a snapshot of one, or a baked field.
        points: (..., 3) m, world frame.
        unknown: As for `sdf`; it affects only `sdf` and `grad` of the answer.

    Returns:
        The answer. Points outside the bounds are not observed.

    Raises:
        ValueError: An argument has a wrong type, shape or value.

    Example:
        >>> answer = hio.query(field, points)
        >>> safe = jnp.minimum(answer.lower, answer.frontier) > robot_radius
    """
    field = as_field(field)
    return _query(field, _checked(points, unknown, "sdf"), unknown=unknown)


def distance(field: AnyField, points: Any, unknown: Unknown, bound: Bound) -> jax.Array:
    """Computes the distance that planning asks for: the estimate, or its lower bound.

    Args:
        field: A map, a snapshot of one, or a baked field.
        points: (..., 3) m, world frame.
        unknown: As for `sdf`.
        bound: "sdf" for the estimate, "lower" for `Query.lower`. With unknown="obstacle" either is
            at most the frontier's distance.

    Returns:
        (...) float32, m. Differentiable.

    Raises:
        ValueError: An argument has a wrong type, shape or value.
    """
    field = as_field(field)
    return _distance(field, _checked(points, unknown, bound), unknown=unknown, bound=bound)


def distance_and_grad(
    field: AnyField, points: Any, unknown: Unknown, bound: Bound
) -> tuple[jax.Array, jax.Array]:
    """Computes `distance` and its gradient (..., 3), by one reverse-mode evaluation."""
    field = as_field(field)
    points = _checked(points, unknown, bound)
    return _distance_and_grad(field, points, unknown=unknown, bound=bound)


def as_field(field: AnyField) -> Field | Baked:
    """Selects what queries read, without a copy.

    Args:
        field: A map, a snapshot of one, or a baked field.

    Returns:
        A field or a baked field.

    Raises:
        ValueError: The argument is something else, or a stack of maps outside `jax.vmap`.
    """
    if isinstance(field, MapState):
        field = field_of(field)
    if not isinstance(field, Field | Baked):
        raise ValueError(
            f"field is {type(field).__name__}, expected a MapState, a Field or a Baked"
        )
    check_single("field", field, _BATCHED)
    return field


# Compiled functions of their own, so that a call outside jit is one dispatch.
_compiled = functools.partial(jax.jit, static_argnames=("unknown", "bound"))


@functools.partial(jax.jit, static_argnames="unknown")
@pointwise
def _query(field: Field | Baked, points: jax.Array, unknown: Unknown) -> Query:
    return _queries(unknown)(field, _clipped(points))


@_compiled
@pointwise
def _distance_and_grad(
    field: Field | Baked, points: jax.Array, unknown: Unknown, bound: Bound
) -> tuple[jax.Array, jax.Array]:
    return _gradients(unknown, bound)(field, _clipped(points))


@_compiled
@pointwise
def _distance(field: Field | Baked, points: jax.Array, unknown: Unknown, bound: Bound) -> jax.Array:
    return _values(unknown, bound)(field, _clipped(points))


@functools.cache
def _values(unknown: Unknown, bound: Bound) -> Evaluate:
    return by_rows(
        functools.partial(_value, unknown=unknown, bound=bound), _gradients(unknown, bound)
    )


@functools.cache
def _gradients(unknown: Unknown, bound: Bound) -> Evaluate:
    return by_rows(functools.partial(_with_gradient, unknown=unknown, bound=bound))


@functools.cache
def _queries(unknown: Unknown) -> Evaluate:
    return by_rows(functools.partial(_all_answers, unknown=unknown))


def _all_answers(field: Field | Baked, points: jax.Array, unknown: Unknown) -> Query:
    place = _place(field, points)
    frontier = _frontier(field, place)
    observed = (frontier > 0) & _answers_of(field).is_certain(field, place.nearest)
    sdf, grad = _with_gradient(field, points, unknown, "sdf")
    lower, lower_grad = _with_gradient(field, points, "network", "lower")
    return Query(sdf, grad, observed, frontier, lower, lower_grad)


def _with_gradient(
    field: Field | Baked, points: jax.Array, unknown: Unknown, bound: Bound
) -> tuple[jax.Array, jax.Array]:
    return value_and_gradient(lambda points: _value(field, points, unknown, bound), points)


def _value(field: Field | Baked, points: jax.Array, unknown: Unknown, bound: Bound) -> jax.Array:
    place = _place(field, points)
    answers = _answers_of(field)
    frontier = _frontier(field, place)
    is_window = isinstance(field, Baked) and field.window
    if bound == "lower":
        value = answers.lower(field, place.nearest) - place.beyond
        value = jnp.where(frontier < 0, jnp.minimum(value, frontier), value)
    else:
        value = answers.sdf(field, place.nearest, unknown)
        # Outside a window the map may have a surface that the window does not know. Outside the
        # bounds an obstacle's gradient must lead back to them.
        nearer = jnp.any(jnp.isnan(points), axis=-1) | is_window | (unknown == "obstacle")
        value = value + jnp.where(nearer, -place.beyond, place.beyond)
    if unknown == "network":
        return value
    solid = jnp.minimum(value, frontier)
    # Deep in unseen space the frontier answers alone: its gradient leads out, that of a guess
    # about what stands there need not. Outside a window it must not lift the value above that of
    # the window's nearest point.
    inside = frontier + place.beyond if is_window else frontier
    deep = jnp.clip(-inside / _DEEP_M, 0, 1)
    return solid + deep * (frontier - solid)


class _Place(NamedTuple):
    """Points relative to the field's box."""

    nearest: jax.Array  # (..., 3) m, the nearest points of the box
    beyond: jax.Array  # (...) m, the distances to it


def _answers_of(field: Field | Baked) -> ModuleType:
    """Chooses the module that answers for this kind of field."""
    return lattice if isinstance(field, Baked) else blend


def _frontier(field: Field | Baked, place: _Place) -> jax.Array:
    value = _answers_of(field).frontier(field, place.nearest)
    # Space outside the bounds is unseen.
    return jnp.where(place.beyond > 0, jnp.minimum(value, 0) - place.beyond, value)


def _place(field: Field | Baked, points: jax.Array) -> _Place:
    low, high = _answers_of(field).bounds(field)
    low, high = jnp.asarray(low, points.dtype), jnp.asarray(high, points.dtype)
    points = jnp.where(jnp.isnan(points), _FAR, points)
    nearest = clip_to_box(points, low, high)
    beyond = points - nearest
    # Scaled by the largest component: the square of a far point would overflow.
    scale = jnp.maximum(jnp.max(jnp.abs(jax.lax.stop_gradient(beyond)), axis=-1), 1e-6)
    square = jnp.sum((beyond / scale[..., None]) ** 2, axis=-1)
    outside = square > 0
    return _Place(nearest, jnp.where(outside, scale * jnp.sqrt(jnp.where(outside, square, 1)), 0))


def _checked(points: Any, unknown: Any, bound: Any) -> jax.Array:
    if not (isinstance(unknown, str) and unknown in ("network", "obstacle")):
        raise ValueError(f"unknown is {unknown!r}, expected 'network' or 'obstacle'")
    if not (isinstance(bound, str) and bound in ("sdf", "lower")):
        raise ValueError(f"bound is {bound!r}, expected 'sdf' or 'lower'")
    points = on_device("points", points)
    check_vectors("points", points)
    return points


def _clipped(points: jax.Array) -> jax.Array:
    """Makes infinite points very far ones: inf - inf would be NaN."""
    return jnp.clip(points, -_FAR, _FAR)
