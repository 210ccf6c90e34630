"""`bake`: a field sampled once on a lattice, so that inner loops only interpolate."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.lattice import sample_counts
from hiosdf_jax._src.field.points import field_of, query
from hiosdf_jax._src.state import Baked, Field, MapState

_CHUNK = 65536  # samples at a time: the network's activations are many times a sample's size


def bake(
    field: MapState | Field,
    resolution: float = 0.05,
    center: Any = None,
    size: Any = None,
) -> Baked:
    """Samples a field on a lattice; the queries answer from it by trilinear interpolation.

    Args:
        field: A map or a snapshot of one.
        resolution: Spacing of the samples, m; static inside jit.
        center: (3,) m, world frame, the middle of a window, for instance the robot; may be traced.
            Without it the whole of the field's bounds is sampled.
        size: (3,) m, the window's edges, with `center` alone; static inside jit.

    Returns:
        The baked field. Its `frontier` is less than the field's by what interpolation may add, so
        that no unseen place looks seen.

    Raises:
        ValueError: An argument is not what it should be.
    """
    if isinstance(field, MapState):
        field = field_of(field)
    if not isinstance(field, Field):
        raise ValueError(f"field is {type(field).__name__}, expected a MapState or a Field")
    if (center is None) != (size is None):
        raise ValueError("center and size are a window's: expected both of them or neither")
    if size is None:
        low, high = np.asarray(field.config.bounds)
        size, corner_world = high - low, jnp.asarray(low, jnp.float32)
    else:
        size = np.asarray(size, float)
        if size.shape != (3,) or not (np.isfinite(size).all() and (size > 0).all()):
            raise ValueError(f"size is {size}, expected three lengths > 0, m")
        center = jnp.asarray(center, jnp.float32)
        if center.shape != (3,):
            raise ValueError(f"center has shape {center.shape}, expected (3,)")
        corner_world = center - jnp.asarray(size / 2, jnp.float32)
    return _bake(field, corner_world, jnp.float32(resolution), sample_counts(size, resolution))


@functools.partial(jax.jit, static_argnums=3)
def _bake(
    field: Field, corner_world: jax.Array, resolution: jax.Array, shape: tuple[int, int, int]
) -> Baked:
    def sample(index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        place = jnp.stack(jnp.unravel_index(index, shape)).astype(jnp.float32)
        answer = query(field, corner_world + place * resolution)
        return answer.sdf, answer.frontier, answer.lower

    count = math.prod(shape)
    sdf, frontier, lower = jax.lax.map(
        sample, jnp.arange(count, dtype=jnp.int32), batch_size=min(count, _CHUNK)
    )
    # Between samples a 1-Lipschitz function may be less by the mean distance to the corners, at
    # most half a cell's diagonal.
    margin = math.sqrt(3) / 2 * resolution
    return Baked(
        corner_world=corner_world,
        resolution=resolution,
        sdf=sdf.reshape(shape),
        frontier=(frontier - margin).reshape(shape),
        lower=lower.reshape(shape),
        updates=field.updates,
        stamp=field.stamp,
    )
