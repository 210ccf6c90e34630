"""A cloud as rays in the world frame."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from voxels import CONFIG

from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.numerics.rigid import is_rigid_on_host


def test_ranges_are_measured_after_a_pose_with_rounding_errors():
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] *= 1.002
    assert is_rigid_on_host(pose)
    cloud = np.array([[0, 0, 0.9991], [0, 0.9, 0], [0.999, 0, 0], [5, 0, 0]], np.float32)
    config = dataclasses.replace(CONFIG, max_range=1.0)
    rays = place_cloud(config, jnp.asarray(cloud), np.ones(4, bool), jnp.asarray(pose))
    np.testing.assert_array_equal(rays.ends, [False, True, False, False])
    np.testing.assert_allclose(rays.free_ranges, [1, 0.9018, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays.directions_world, axis=1), 1, rtol=1e-6)


def test_the_deviation_of_a_return_grows_with_its_range_up_to_the_largest():
    cloud = np.array([[0, 0, 0.5], [0, 2.0, 0], [9.0, 0, 0]], np.float32)
    pose = jnp.eye(4)
    ranges = np.array([0.5, 2.0, CONFIG.max_range])
    for noise in (None, (0.02, 0.004)):
        rays = place_cloud(CONFIG, jnp.asarray(cloud), np.ones(3, bool), pose, noise)
        a, b = noise or CONFIG.range_noise
        np.testing.assert_allclose(rays.sigma, a + b * ranges**2, rtol=1e-6)
