"""Rigid motions: the check of a pose, outside jit and inside, and its exact rotation."""

from __future__ import annotations

from operator import mul

import jax
import jax.numpy as jnp
import numpy as np

FARTHEST_M = 1e5
"""Largest coordinate of a position, m; float32 resolves 8 mm there."""

TOLERANCE = 5e-3
"""Largest deviation of R^T R from the identity; real trajectories have few digits."""

_ROUNDING = 1e-6  # of the last row


def is_rigid(pose: jax.Array) -> jax.Array:
    """Returns whether a matrix is a rotation and a translation.

    Args:
        pose: (4, 4).

    Returns:
        () bool; False for a pose that is not finite or farther than 100 km from the origin.
    """
    rotation = pose[:3, :3]
    # Sums of products by hand: a matrix product may run in reduced precision on a GPU.
    gram = jnp.sum(rotation[:, :, None] * rotation[:, None, :], axis=0)
    handed = jnp.sum(jnp.cross(rotation[0], rotation[1]) * rotation[2])
    orthonormal = jnp.all(jnp.abs(gram - jnp.eye(3)) <= TOLERANCE)
    last_row = jnp.all(jnp.abs(pose[3] - jnp.array([0.0, 0, 0, 1])) <= _ROUNDING)
    near = jnp.all(jnp.abs(pose[:3, 3]) <= FARTHEST_M)
    return orthonormal & last_row & (handed > 0) & near & jnp.all(jnp.isfinite(pose))


def is_rigid_on_host(pose: np.ndarray) -> bool:
    """Computes `is_rigid` outside jit, in plain Python: numpy takes ten times as long for it."""
    *rows, last = pose.tolist()
    position = [row.pop() for row in rows]
    columns = list(zip(*rows, strict=True))
    orthonormal = all(
        abs(sum(map(mul, columns[i], columns[j])) - (i == j)) <= TOLERANCE
        for i in range(3)
        for j in range(i + 1)
    )
    (a, b, c), (d, e, f), third = rows
    normal = b * f - c * e, c * d - a * f, a * e - b * d
    handed = sum(map(mul, normal, third)) > 0
    near = all(abs(part) <= FARTHEST_M for part in position)
    return (
        orthonormal
        and handed
        and near
        and all(abs(part - (k == 3)) <= _ROUNDING for k, part in enumerate(last))
    )


def nearest_rotation(matrix: jax.Array) -> jax.Array:
    """Returns the rotation nearest to a matrix (3, 3) that `is_rigid` accepts.

    Newton's iteration for the polar decomposition: the deviation is squared in each step. A matrix
    that is a rotation already keeps its digits.
    """
    for _ in range(3):
        gram = jnp.sum(matrix[:, :, None] * matrix[:, None, :], axis=0)
        step = 1.5 * jnp.eye(3, dtype=matrix.dtype) - 0.5 * gram
        matrix = jnp.sum(matrix[:, :, None] * step[None], axis=1)
    return matrix
