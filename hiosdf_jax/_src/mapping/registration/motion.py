"""Small motions of a pose: three components of translation, m, and three of rotation, rad.

Both are along the axes of the world frame, and the rotation is about the sensor.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.numerics.point_kernel import by_points
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
    return by_points(_move_at, None, (), pose.reshape(1, 16), motion[None], least=1).reshape(4, 4)


def _move_at(static: None, tables: Any, pose: Any, motion: Any) -> tuple[jax.Array, ...]:
    """Moves poses whose sixteen numbers are arrays of their own."""
    turn = _rotation_entries(*motion[3:])

    def entry(i: int, j: int) -> jax.Array:
        if j == 3:
            return pose[4 * i + 3] + motion[i]
        x, y, z = turn[3 * i : 3 * i + 3]
        return x * pose[j] + y * pose[4 + j] + z * pose[8 + j]

    return (*(entry(i, j) for i in range(3) for j in range(4)), *pose[12:])


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


def distance_and_angle(first: jax.Array, second: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes how far two poses (..., 4, 4) are apart, (...) m and rad, for turns up to pi.

    Angles below 1e-3 rad are lost to rounding; `motion_between` has them.
    """
    distance = jnp.linalg.norm(second[..., :3, 3] - first[..., :3, 3], axis=-1)
    cosine = (jnp.sum(first[..., :3, :3] * second[..., :3, :3], axis=(-2, -1)) - 1) / 2
    return distance, jnp.arccos(jnp.clip(cosine, -1, 1))


def rotation_of(vector: jax.Array) -> jax.Array:
    """Computes the rotation about a vector (3,) by its length, rad; (3, 3)."""
    x, y, z = vector
    return jnp.stack(_rotation_entries(x, y, z)).reshape(3, 3)


def _rotation_entries(x: jax.Array, y: jax.Array, z: jax.Array) -> list[jax.Array]:
    """The numbers of `rotation_of`, row by row."""
    square = x * x + y * y + z * z
    small = square < _SMALL**2
    angle = jnp.sqrt(jnp.where(small, 1, square))
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    across, vector = [[None, -z, y], [z, None, -x], [-y, x, None]], (x, y, z)
    return [
        1 - second * (square - vector[i] ** 2)
        if i == j
        else first * across[i][j] + second * vector[i] * vector[j]
        for i in range(3)
        for j in range(3)
    ]


def vector_of(rotation: jax.Array) -> jax.Array:
    """Computes the rotation vector, (3,) rad, of a rotation (3, 3) by less than pi."""
    across = rotation - rotation.T
    twice = jnp.stack([across[2, 1], across[0, 2], across[1, 0]])
    square = jnp.sum(twice**2) / 4  # of the sine
    small = square < _SMALL**2
    sine = jnp.sqrt(jnp.where(small, 1, square))
    angle = jnp.arctan2(sine, (jnp.trace(rotation) - 1) / 2)
    return twice / 2 * jnp.where(small, 1 + square / 6, angle / sine)
