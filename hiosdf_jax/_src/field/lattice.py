"""Answers of a baked field: samples on a regular lattice, interpolated trilinearly.

`blend` has the same functions for a live map: `bounds`, `sdf`, `frontier`, `is_certain`,
`lower`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.intake import as_number
from hiosdf_jax._src.state.pytrees import Baked, Unknown

_MOST_SAMPLES = 2**31 - 1


def bounds(baked: Baked) -> tuple[jax.Array, jax.Array]:
    """Returns the corners of the box that a baked field covers, (3,) m each, world frame."""
    last = jnp.asarray(baked.sdf.shape, jnp.float32) - 1
    return baked.corner_world, baked.corner_world + last * baked.resolution


def sdf(baked: Baked, points_world: jax.Array, unknown: Unknown) -> jax.Array:
    """Interpolates the signed distance at points (..., 3) m inside the box; (...) m.

    The samples are the same for each policy for unseen space.
    """
    del unknown
    return interpolate(baked, baked.sdf, points_world)


def frontier(baked: Baked, points_world: jax.Array) -> jax.Array:
    """Interpolates the distance to unseen space at points (..., 3) m inside the box; (...) m."""
    return interpolate(baked, baked.frontier, points_world)


def is_certain(baked: Baked, points_world: jax.Array) -> jax.Array:
    """Returns true, (...) bool, for points (..., 3) m: the samples do not tell."""
    del baked
    return jnp.ones(points_world.shape[:-1], bool)


def lower(baked: Baked, points_world: jax.Array) -> jax.Array:
    """Interpolates the lower bound of the distance at points (..., 3) m inside the box; (...) m."""
    return interpolate(baked, baked.lower, points_world)


def sample_counts(size: Any, resolution: float) -> tuple[int, int, int]:
    """Counts the samples that cover a box, with samples on or beyond both faces of each axis.

    Args:
        size: Edges of the box, (3,) m.
        resolution: Spacing, m.

    Returns:
        Samples along x, y and z, each at least 2.

    Raises:
        ValueError: The spacing is not positive, or needs too many samples.
    """
    spacing = check_resolution(resolution)
    # Tolerant, so that 3 m at 0.1 m are 31 samples and not 32.
    with np.errstate(over="ignore"):
        counts = np.maximum(np.ceil(np.asarray(size, float) / spacing - 1e-6), 1) + 1
        total = counts.prod()
    if not total <= _MOST_SAMPLES:
        raise ValueError(
            f"resolution is {resolution} m, which needs {total:.10g} samples, expected at most "
            f"{_MOST_SAMPLES}"
        )
    x, y, z = (int(count) for count in counts)
    return x, y, z


def check_resolution(resolution: Any) -> float:
    """Returns a spacing, m, or raises a ValueError if it is not positive."""
    return as_number("resolution", resolution, 0, above=True)


def interpolate(baked: Baked, values: jax.Array, points_world: jax.Array) -> jax.Array:
    """Interpolates samples trilinearly.

    Args:
        baked: The baked field.
        values: One of its arrays, (X, Y, Z).
        points_world: (..., 3) m, inside its box.

    Returns:
        (...). Differentiable: the gradient is that of the trilinear function.
    """
    shape = values.shape
    lattice_points = (points_world - baked.corner_world) / baked.resolution
    base = jnp.floor(jax.lax.stop_gradient(lattice_points))
    base = jnp.clip(base, 0, jnp.asarray(shape, jnp.float32) - 2)
    fraction = lattice_points - base
    x, y, z = (base[..., k].astype(jnp.int32) for k in range(3))
    flat = values.ravel()
    first = (x * shape[1] + y) * shape[2] + z

    def along_z(start: jax.Array) -> jax.Array:
        low, high = flat[start], flat[start + 1]
        return low + fraction[..., 2] * (high - low)

    def along_yz(start: jax.Array) -> jax.Array:
        low, high = along_z(start), along_z(start + shape[2])
        return low + fraction[..., 1] * (high - low)

    low, high = along_yz(first), along_yz(first + shape[1] * shape[2])
    return low + fraction[..., 0] * (high - low)
