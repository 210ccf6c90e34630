"""The check that a pose is rigid, for `posed_cloud` outside jit and `mapping.pipeline` inside."""

from __future__ import annotations

from typing import Any

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
