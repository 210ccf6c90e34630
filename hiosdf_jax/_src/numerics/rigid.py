"""What makes a pose usable: finite, and rigid to the digits that it was written with."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

# How far R^T R may be from the identity: real trajectories are written with few digits.
_TOLERANCE = 5e-3


def is_rigid(pose: Any, np: Any = jnp) -> Any:
    """Tells a rotation and a translation from any other matrix.

    Args:
        pose: (4, 4).
        np: The library to compute with; numpy outside jit costs no dispatches to a device.

    Returns:
        () bool; False for a pose that is not finite.
    """
    rotation = pose[:3, :3]
    # Sums of products by hand: a matrix product may run in reduced precision on a GPU.
    gram = np.sum(rotation[:, :, None] * rotation[:, None, :], axis=0)
    handed = np.sum(np.cross(rotation[0], rotation[1]) * rotation[2])
    orthonormal = np.all(np.abs(gram - np.eye(3)) <= _TOLERANCE)
    last_row = np.all(np.abs(pose[3] - np.array([0.0, 0, 0, 1])) <= 1e-6)
    return orthonormal & last_row & (handed > 0) & np.all(np.isfinite(pose))
