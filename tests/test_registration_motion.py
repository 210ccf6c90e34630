"""Small motions of poses, against scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.mapping.registration.motion import (
    distance_and_angle,
    motion_between,
    move,
    rotation_of,
    vector_of,
)

ANGLES = [0.0, 1e-6, 9e-4, 1.1e-3, 0.1, 2.0, 3.0]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_are_those_of_scipy(angle):
    vector = np.random.default_rng(0).normal(size=3)
    vector *= angle / np.linalg.norm(vector)
    rotation = rotation_of(jnp.asarray(vector, jnp.float32))
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(vector_of(rotation), vector, atol=2e-6)


def test_a_motion_leads_from_one_pose_to_another():
    rng = np.random.default_rng(1)
    first, second = np.eye(4, dtype=np.float32), np.eye(4, dtype=np.float32)
    first[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    second[:3, :3] = Rotation.from_rotvec([0.1, 0.4, 0.8]).as_matrix()
    first[:3, 3], second[:3, 3] = rng.normal(size=(2, 3))
    np.testing.assert_allclose(move(first, motion_between(first, second)), second, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.01, 1.0, 3.0, np.pi])
def test_poses_are_apart_by_a_way_and_an_angle(angle):
    first, second = np.eye(4), np.eye(4)
    first[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    second[:3, :3] = Rotation.from_rotvec([0, angle, 0]).as_matrix() @ first[:3, :3]
    second[:3, 3] = [3, 0, 4]
    np.testing.assert_allclose(distance_and_angle(first, second), [5, angle], atol=1e-3)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_derivatives_are_finite_and_right(angle):
    vector = jnp.asarray([0.6, 0.0, 0.8]) * angle
    slope = jax.jacfwd(lambda v: vector_of(rotation_of(v)))(vector)
    np.testing.assert_allclose(slope, np.eye(3), atol=1e-3)
