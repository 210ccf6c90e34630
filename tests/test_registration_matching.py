"""What returns are compared with: planes if they are noisy, the map's own distances otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import HALF, room_cloud, room_sdf

from hiosdf_jax._src.grid.lookup import nearest_patch
from hiosdf_jax._src.mapping.registration.comparing import compare, make_rows
from hiosdf_jax._src.state.pytrees import field_of

COUNT = 1000
OFF_M = 0.04


@jax.jit
def compared(field, cloud, pose, noise_m, growing):
    rows = make_rows(cloud, jnp.ones(len(cloud), bool), (noise_m, jnp.float32(0)), growing)
    return compare(field, rows, pose, 0.0)


def walls(seed=71):
    """Exact returns from the middle of the walls, far from corners, and the pose."""
    cloud, pose = room_cloud(seed, 8 * COUNT)
    second = np.sort(HALF - np.abs(cloud), axis=1)[:, 1]
    return cloud[second > 0.3][:COUNT], pose


def norms(cloud):
    return np.linalg.norm(cloud, axis=1, keepdims=True)


def distances(field, off_m, noise_m, growing=0.0):
    """Distances of returns moved along their rays, the exact ones, and which can be compared."""
    cloud, pose = walls()
    moved = (cloud + off_m * cloud / norms(cloud)).astype(np.float32)
    found = compared(field, moved, pose, jnp.float32(noise_m), growing)
    return np.asarray(found.distance), room_sdf(moved), np.asarray(found.comparable)


@pytest.mark.parametrize("off_m", [-OFF_M, OFF_M])
def test_the_distance_of_a_noisy_return_is_linear_through_a_wall(sharp_map, off_m):
    found, exact, usable = distances(field_of(sharp_map), off_m, 0.05)
    assert usable.mean() > 0.9
    assert np.percentile(np.abs(found - exact)[usable], 95) < 0.001


def test_an_exact_return_has_the_distance_of_the_map(sharp_map):
    field = field_of(sharp_map)
    cloud, _ = walls()
    found, _, usable = distances(field, -OFF_M, 0.005)
    own = nearest_patch(field.config, field.surface, cloud * (1 - OFF_M / norms(cloud)))
    assert usable.mean() > 0.9
    np.testing.assert_allclose(found[usable], np.asarray(own.sdf)[usable], atol=1e-5)


def test_noise_changes_no_distance_in_a_map_that_grows(sharp_map):
    exact, noisy = (distances(field_of(sharp_map), OFF_M, noise, 1.0) for noise in (0.005, 0.05))
    np.testing.assert_array_equal(exact[0], noisy[0])


def test_a_distance_changes_continuously_with_the_noise(sharp_map):
    noises = np.linspace(0.005, 0.05, 91)
    found = np.stack([distances(field_of(sharp_map), OFF_M, noise)[0] for noise in noises])
    change = np.abs(np.diff(found, axis=0)).max(axis=0)
    whole = np.abs(found[-1] - found[0])
    assert np.all(change <= 0.05 * whole + 1e-5)
