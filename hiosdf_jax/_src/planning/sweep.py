"""Clearance of spheres along a motion, a lower bound that nothing tunnels through.

A distance changes by at most slope times the distance traveled. Its values at the ends of a
segment of length w therefore bound it in between: no value is below (d(a) + d(b) - slope * w) / 2.
Each evaluation halves the segment with the lowest bound (branch and bound; Piyavskii, 1972). One
segment is enough far from surfaces, and the bound is tight where a sphere comes close.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.queries import AnyField, Unknown, as_field, distance
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.intake import as_number, check_whole, is_traced
from hiosdf_jax._src.numerics.modes import plain, pointwise, varying_like
from hiosdf_jax._src.numerics.vectors import length, split
from hiosdf_jax._src.planning.clearance import checked_spheres
from hiosdf_jax._src.state.pytrees import Baked, Bound, Field

# m; farther points are clipped, so that the square of a length does not overflow.
_FAR = 1e18


def swept_clearance(
    field: AnyField,
    start_world: Any,
    end_world: Any,
    radii: Any,
    unknown: Unknown = "obstacle",
    slope: Any = 1.1,
    evaluations: int = 9,
    bound: Bound = "sdf",
) -> jax.Array:
    """Computes a lower bound of the clearance of spheres along straight lines.

    The bound holds for every field that is no steeper than `slope` along the line. Exact distances
    have slope 1. A map's distance jumps in a few places, most of them in unobserved space, and its
    baked copy has steep cells there: with the default slope, 0.2 % of motions of 0.2 m through a
    mapped house had a bound more than 1 mm too high.

    The gradient is that of the segment with the lowest bound. It costs two evaluations, however
    many find the segment.

    Example:
        start_world = jnp.array([[0.5, 0.0, 0.3]])
        end_world = start_world + jnp.array([0.2, 0.0, 0.0])
        clearance = planning.swept_clearance(field, start_world, end_world, radii=0.1)

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        start_world: (..., 3) m, centers of the spheres.
        end_world: (..., 3) m, where they move along straight lines. A robot's joints move them
            along arcs: divide a motion until arc and chord differ by less than your margin.
        radii: m, >= 0; any shape that broadcasts to that of the spheres, (...).
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.
        slope: Steepest slope of the field, m per m, () > 0.
        evaluations: Evaluations of the field per sphere, 2 to 10,000; a whole number, not traced.

    Returns:
        (...) float32, m. Differentiable.

    Raises:
        ValueError: A shape or `evaluations` is wrong, or (outside jit) a radius is negative or not
            finite, or the slope is not positive.
    """
    return _swept(
        *_checked(field, start_world, end_world, radii, slope, evaluations),
        unknown=unknown,
        bound=bound,
        evaluations=int(evaluations),
    )


@plain
def swept_clearance_and_grad(
    field: AnyField,
    start_world: Any,
    end_world: Any,
    radii: Any,
    unknown: Unknown = "obstacle",
    slope: Any = 1.1,
    evaluations: int = 9,
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes the clearance of motions and its gradients, by one reverse-mode evaluation.

    Example:
        start_world = jnp.array([[0.5, 0.0, 0.3]])
        clearance, by_start, by_end = planning.swept_clearance_and_grad(
            field, start_world, start_world + 0.2, radii=0.1
        )

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        start_world: (..., 3) m, centers of the spheres.
        end_world: (..., 3) m, where they move along straight lines.
        radii: As for `swept_clearance`.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        slope: As for `swept_clearance`.
        evaluations: As for `swept_clearance`.
        bound: As for `swept_clearance`.

    Returns:
        The clearance (...) float32, m, and its gradients by start and end, (..., 3) float32 each.

    Raises:
        ValueError: As for `swept_clearance`.
    """
    field, start, end, *rest = _checked(field, start_world, end_world, radii, slope, evaluations)

    def value(start: jax.Array, end: jax.Array) -> jax.Array:
        chosen = {"unknown": unknown, "bound": bound, "evaluations": int(evaluations)}
        return _swept(field, start, end, *rest, **chosen)

    clearance, pull = jax.vjp(value, start, end)
    by_start, by_end = pull(jnp.ones_like(clearance))
    return clearance, by_start, by_end


def _checked(
    field: AnyField, start_world: Any, end_world: Any, radii: Any, slope: Any, evaluations: int
) -> tuple[Any, jax.Array, jax.Array, jax.Array, jax.Array]:
    start, radii = checked_spheres(start_world, radii, "start_world")
    end = on_device("end_world", end_world)
    shapes = start.shape, end.shape
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"end_world has shape {shapes[1]}, expected that of start_world {shapes[0]}"
        )
    check_whole("evaluations", evaluations, 2, _MOST_EVALUATIONS)
    if not is_traced(slope):
        slope = as_number("slope", slope, 0, above=True)
    slope = on_device("slope", slope)
    # Inside jit an invalid slope counts as steep: the motion is in collision.
    slope = jnp.where((slope > 0) & (slope <= _STEEPEST), slope, _STEEPEST)
    return as_field(field), start, end, radii, slope


_STEEPEST = 1e6
_MOST_EVALUATIONS = 10_000  # each looks through all segments so far

_CHOICES = ("unknown", "bound", "evaluations")


@functools.partial(jax.jit, static_argnames=_CHOICES)
@pointwise
def _swept(
    field: Field | Baked,
    start: jax.Array,
    end: jax.Array,
    radii: jax.Array,
    slope: jax.Array,
    unknown: Unknown,
    bound: Bound,
    evaluations: int,
) -> jax.Array:
    start, end = jnp.clip(start, -_FAR, _FAR), jnp.clip(end, -_FAR, _FAR)
    frozen = jax.lax.stop_gradient((field, start, end, slope))
    low, high = _lowest_segment(*frozen, unknown=unknown, bound=bound, evaluations=evaluations)
    way = end - start
    points = jnp.stack([start + t[..., None] * way for t in (low, high)])
    values = distance(field, points, unknown, bound)
    return _bound(values[0], values[1], (high - low) * length(split(way)), slope) - radii


# Compiled by itself: a gradient need not go through it.
@functools.partial(jax.jit, static_argnames=_CHOICES)
def _lowest_segment(
    field: Field | Baked,
    start: jax.Array,
    end: jax.Array,
    slope: jax.Array,
    unknown: Unknown,
    bound: Bound,
    evaluations: int,
) -> tuple[jax.Array, jax.Array]:
    """Start and end of the segment with the lowest bound, as fractions of the way, (...) each."""
    way = end - start
    reach = length(split(way))
    segments = evaluations - 1
    shape = (*reach.shape, segments)
    slot = jnp.arange(segments)

    def bounds(parts: tuple[jax.Array, ...]) -> jax.Array:
        _, width, first, last = parts
        return _bound(first, last, width * reach[..., None], slope)

    def halve(count: jax.Array, parts: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        lowest = jnp.argmin(jnp.where(slot < count, bounds(parts), jnp.inf), axis=-1)[..., None]
        share, width, first, last = (jnp.take_along_axis(array, lowest, axis=-1) for array in parts)
        width = width / 2
        middle = distance(field, start + (share + width) * way, unknown, bound)[..., None]
        here, new = slot == lowest, slot == count
        left, right = (share, width, first, middle), (share + width, width, middle, last)
        return tuple(
            jnp.where(new, b, jnp.where(here, a, array))
            for array, a, b in zip(parts, left, right, strict=True)
        )

    ends = distance(field, jnp.stack([start, end]), unknown, bound)
    first, last = jnp.broadcast_to(ends[..., None], (2, *shape))
    whole = (jnp.zeros(shape, jnp.float32), jnp.ones(shape, jnp.float32), first, last)
    start_from = varying_like(whole, field, start, end, slope)
    parts = jax.lax.fori_loop(1, segments, halve, start_from)
    lowest = jnp.argmin(bounds(parts), axis=-1)[..., None]
    share, width = (jnp.take_along_axis(array, lowest, axis=-1)[..., 0] for array in parts[:2])
    return share, share + width


def _bound(first: jax.Array, last: jax.Array, width: jax.Array, slope: jax.Array) -> jax.Array:
    # Where the field is steeper than `slope`, the cones from the ends meet outside the segment: the
    # bound is then at most the lower end.
    return jnp.minimum((first + last - slope * width) / 2, jnp.minimum(first, last))
