"""How far moving spheres stay from collision, between the poses that a planner looks at.

A distance changes by at most the length of the way, so that its values at the ends of a segment
bound it in between: over a segment of length w from a to b no value is less than
(d(a) + d(b) - slope * w) / 2. Each evaluation is spent on halving the segment whose bound is the
lowest (branch and bound; Piyavskii, 1972): where a sphere is far from everything one segment is
enough, and where it comes close the bound is tight.
"""

from __future__ import annotations

import functools
import math
import numbers
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.points import AnyField, Unknown, as_field, sdf
from hiosdf_jax._src.planning.clearance import checked_radii

# Points farther than this, m, are taken as so far: the square of a length must not overflow.
_FAR = 1e18


def swept_clearance(
    field: AnyField,
    start_world: Any,
    end_world: Any,
    radii: Any,
    unknown: Unknown = "network",
    slope: Any = 1.1,
    evaluations: int = 9,
) -> jax.Array:
    """Lower bound of the clearance of spheres all along straight lines: nothing is tunnelled.

    It is one for every field that is no steeper than `slope` along the line. Exact distances have
    slope 1. A served map jumps in a few places, most of them in unseen space, and a baked one has
    cells there that are steep: with the default, 0.2 % of motions of 0.2 m through a mapped house
    had a bound that was more than 1 mm too high.

    The gradient is that of the segment which has the lowest bound: two evaluations, whatever
    their number.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        start_world: (..., 3) m, centers of the spheres.
        end_world: (..., 3) m, where they move to, along straight lines. A robot's joints move
            them along arcs: divide a motion until arc and chord differ less than your margin.
        radii: m, >= 0; any shape that broadcasts to that of the spheres, (...).
        unknown: As for `sdf`.
        slope: The steepest that the field is, m per m, () > 0.
        evaluations: Of the field, for each sphere, >= 2; a whole number, not traced.

    Returns:
        (...) float32, m. Differentiable.

    Raises:
        ValueError: A shape is wrong, `evaluations` is, or (outside jit) a radius is negative or
            not finite, or the slope is not positive.
    """
    shapes = np.shape(start_world), np.shape(end_world)
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"end_world has shape {shapes[1]}, expected that of start_world {shapes[0]}"
        )
    radii = checked_radii(radii, start_world, "start_world")
    if not isinstance(evaluations, numbers.Integral) or evaluations < 2:
        raise ValueError(f"evaluations is {evaluations!r}, expected a whole number >= 2")
    if not isinstance(slope, jax.core.Tracer) and not (math.isfinite(slope) and slope > 0):
        raise ValueError(f"slope is {slope}, expected > 0 and finite")
    start, end = (
        jnp.clip(jnp.asarray(points, jnp.float32), -_FAR, _FAR)
        for points in (start_world, end_world)
    )
    slope = jnp.asarray(slope, jnp.float32)
    answering = as_field(field)
    frozen = jax.lax.stop_gradient((answering, start, end, slope))
    low, high = _lowest_segment(*frozen, unknown=unknown, evaluations=int(evaluations))
    way = end - start
    values = sdf(answering, jnp.stack([start + t[..., None] * way for t in (low, high)]), unknown)
    return _bound(values[0], values[1], (high - low) * _length(way), slope) - radii


@functools.partial(jax.jit, static_argnames=("unknown", "evaluations"))
def _lowest_segment(
    field: AnyField,
    start: jax.Array,
    end: jax.Array,
    slope: jax.Array,
    unknown: Unknown,
    evaluations: int,
) -> tuple[jax.Array, jax.Array]:
    """Where the segment of the lowest bound starts and ends, shares of the way, (...) each."""
    way = end - start
    length = _length(way)
    segments = evaluations - 1
    shape = (*length.shape, segments)
    slot = jnp.arange(segments)

    def bounds(parts: tuple[jax.Array, ...]) -> jax.Array:
        _, width, first, last = parts
        return _bound(first, last, width * length[..., None], slope)

    def halve(count: jax.Array, parts: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        lowest = jnp.argmin(jnp.where(slot < count, bounds(parts), jnp.inf), axis=-1)[..., None]
        share, width, first, last = (jnp.take_along_axis(array, lowest, axis=-1) for array in parts)
        width = width / 2
        middle = sdf(field, start + (share + width) * way, unknown)[..., None]
        here, new = slot == lowest, slot == count
        left, right = (share, width, first, middle), (share + width, width, middle, last)
        return tuple(
            jnp.where(new, b, jnp.where(here, a, array))
            for array, a, b in zip(parts, left, right, strict=True)
        )

    ends = sdf(field, jnp.stack([start, end]), unknown)
    first, last = jnp.broadcast_to(ends[..., None], (2, *shape))
    whole = (jnp.zeros(shape), jnp.ones(shape), first, last)
    parts = jax.lax.fori_loop(1, segments, halve, whole)
    lowest = jnp.argmin(bounds(parts), axis=-1)[..., None]
    share, width = (jnp.take_along_axis(array, lowest, axis=-1)[..., 0] for array in parts[:2])
    return share, share + width


def _bound(first: jax.Array, last: jax.Array, width: jax.Array, slope: jax.Array) -> jax.Array:
    # Where the field is steeper than it should be, the cones from the ends meet outside the
    # segment: the bound is then no more than the lower end.
    return jnp.minimum((first + last - slope * width) / 2, jnp.minimum(first, last))


def _length(way: jax.Array) -> jax.Array:
    square = jnp.sum(way**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
