"""Small motions of a pose: three components of translation, m, and three of rotation, rad.

Both are along the axes of the world frame, and the rotation is about the sensor.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.numerics.small_matrices import product

# Below this angle, rad, series replace quotients of small numbers.
_SMALL = 1e-3


def move(pose: jax.Array, motion: jax.Array) -> jax.Array:
    """Moves a pose.

    Args:
        pose: (4, 4) T_world_sensor.
        motion: (6,) m and rad.

    Returns:
        (4, 4).
    """
    pose = jnp.asarray(pose)
    rotation = product(rotation_of(motion[3:]), pose[:3, :3])
    moved = jnp.concatenate([rotation, (pose[:3, 3] + motion[:3])[:, None]], axis=1)
    return jnp.concatenate([moved, pose[3:]])


def offsets_from(pose: jax.Array, points: jax.Array) -> jax.Array:
    """Turns points of the sensor frame to the axes of the world, relative to the sensor.

    Args:
        pose: (4, 4) T_world_sensor.
        points: (N, 3) m, sensor frame.

    Returns:
        (N, 3) m. Exact float32 sums, where a GPU's product of matrices may round to fewer bits.
    """
    return jnp.sum(points[:, None, :] * pose[:3, :3], axis=-1)


def motion_between(first: jax.Array, second: jax.Array) -> jax.Array:
    """Computes the motion that leads from one pose to another.

    Args:
        first: (4, 4) T_world_sensor.
        second: (4, 4), turned by less than pi from the first.

    Returns:
        (6,) m and rad: `move(first, motion)` is `second`.
    """
    turn = product(second[:3, :3], first[:3, :3].T)
    vector = vector_of(turn)
    return jnp.concatenate([second[:3, 3] - first[:3, 3], vector])


def way_and_angle(first: jax.Array, second: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes how far two poses (..., 4, 4) are apart, (...) m and rad, for turns up to pi.

    Angles below 1e-3 rad are lost to rounding; `motion_between` has them.
    """
    way = jnp.linalg.norm(second[..., :3, 3] - first[..., :3, 3], axis=-1)
    cosine = (jnp.sum(first[..., :3, :3] * second[..., :3, :3], axis=(-2, -1)) - 1) / 2
    return way, jnp.arccos(jnp.clip(cosine, -1, 1))


def rotation_of(vector: jax.Array) -> jax.Array:
    """Computes the rotation about a vector (3,) by its length, rad; (3, 3)."""
    square = jnp.sum(vector**2)
    small = square < _SMALL**2
    angle = jnp.sqrt(jnp.where(small, 1, square))
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    across = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return (
        (1 - second * square) * jnp.eye(3, dtype=jnp.float32)
        + first * across
        + second * vector[:, None] * vector
    )


def vector_of(rotation: jax.Array) -> jax.Array:
    """Computes the rotation vector, (3,) rad, of a rotation (3, 3) by less than pi."""
    across = rotation - rotation.T
    twice = jnp.stack([across[2, 1], across[0, 2], across[1, 0]])
    square = jnp.sum(twice**2) / 4  # of the sine
    small = square < _SMALL**2
    sine = jnp.sqrt(jnp.where(small, 1, square))
    angle = jnp.arctan2(sine, (jnp.trace(rotation) - 1) / 2)
    return twice / 2 * jnp.where(small, 1 + square / 6, angle / sine)
