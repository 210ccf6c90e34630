"""The rows of a cloud that are on moving or new things."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, room_cloud

import hiosdf_jax as hio


def cloud_with_a_thing():
    """A cloud of the room whose first 60 returns are on something in front of the wall."""
    cloud, pose = room_cloud(3)
    cloud = cloud.copy()
    cloud[:60] *= 0.4
    return cloud, pose


def test_returns_in_free_space_are_found_and_those_on_walls_are_not(sharp_map):
    cloud, pose = cloud_with_a_thing()
    moving = np.asarray(hio.moving_rows(sharp_map, cloud, pose))
    assert moving.shape == (250,)
    # Some of the first 60 are still near a wall.
    clear = np.linalg.norm(cloud[:60], axis=1) < 0.55
    assert clear.sum() > 30
    assert moving[:60][clear].mean() > 0.95
    assert not moving[60:].any()
    after = hio.update(sharp_map, cloud, pose)
    assert int(after.report.points_moving) == moving.sum()


def test_an_empty_map_calls_nothing_moving(empty_map):
    assert not np.asarray(hio.moving_rows(empty_map, *cloud_with_a_thing())).any()


def test_any_number_of_rows_and_rows_without_a_return(sharp_map):
    cloud, pose = cloud_with_a_thing()
    expected = np.asarray(hio.moving_rows(sharp_map, cloud, pose))
    many = np.full((700, 3), np.nan, np.float32)
    many[400:650] = cloud
    many[650] = np.inf
    found = np.asarray(hio.moving_rows(sharp_map, many, pose))
    np.testing.assert_array_equal(found[400:650], expected)
    assert found.sum() == expected.sum()
    assert hio.moving_rows(sharp_map, np.zeros((0, 3)), pose).shape == (0,)


def test_inside_jit_it_is_the_same(sharp_map):
    cloud, pose = (jnp.asarray(array) for array in cloud_with_a_thing())
    inside = jax.jit(hio.moving_rows)(sharp_map, cloud, pose)
    np.testing.assert_array_equal(inside, hio.moving_rows(sharp_map, cloud, pose))


def test_a_poor_sensor_needs_more_distance(sharp_map):
    cloud, pose = cloud_with_a_thing()
    sharp = np.asarray(hio.moving_rows(sharp_map, cloud, pose))
    poor = np.asarray(hio.moving_rows(sharp_map, cloud, pose, noise=(0.2, 0.0)))
    assert poor.sum() < sharp.sum()
    assert not (poor & ~sharp).any()


def test_bad_arguments_are_named(sharp_map):
    cloud, pose = room_cloud(0)
    with pytest.raises(ValueError, match="state is Config"):
        hio.moving_rows(CONFIG, cloud, pose)
    with pytest.raises(ValueError, match="cloud has shape"):
        hio.moving_rows(sharp_map, cloud[:, :2], pose)
    with pytest.raises(ValueError, match="pose is not rigid"):
        hio.moving_rows(sharp_map, cloud, np.diag([2.0, 2, 2, 1]))
    with pytest.raises(ValueError, match="noise"):
        hio.moving_rows(sharp_map, cloud, pose, noise=3)
