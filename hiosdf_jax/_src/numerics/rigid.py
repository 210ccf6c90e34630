"""Rigid motions: the check of a pose, outside jit and inside, and its exact rotation."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

FARTHEST_M = 1e5
"""Largest coordinate of a position, m; float32 resolves 8 mm there."""

TOLERANCE = 5e-3
"""Largest deviation of R^T R from the identity; real trajectories have few digits."""


def is_rigid(pose: Any, np: Any = jnp) -> Any:
    """Returns whether a matrix is a rotation and a translation.

    Args:
        pose: (4, 4).
        np: jax.numpy, or numpy to avoid dispatches to a device outside jit.

    Returns:
        () bool; False for a pose that is not finite or farther than 100 km from the origin.
    """
    rotation = pose[:3, :3]
    # Sums of products by hand: a matrix product may run in reduced precision on a GPU.
    gram = np.sum(rotation[:, :, None] * rotation[:, None, :], axis=0)
    handed = np.sum(np.cross(rotation[0], rotation[1]) * rotation[2])
    orthonormal = np.all(np.abs(gram - np.eye(3)) <= TOLERANCE)
    last_row = np.all(np.abs(pose[3] - np.array([0.0, 0, 0, 1])) <= 1e-6)
    near = np.all(np.abs(pose[:3, 3]) <= FARTHEST_M)
    return orthonormal & last_row & (handed > 0) & near & np.all(np.isfinite(pose))


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
