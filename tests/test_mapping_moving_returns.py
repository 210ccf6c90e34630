"""The rows of a cloud that are on moving or new things."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF, room_cloud

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


def test_returns_on_the_robot_are_not_moving(sharp_map):
    cloud, pose = cloud_with_a_thing()
    centers = cloud[:60] @ pose[:3, :3].T + pose[:3, 3]
    robot = (centers, np.full(60, 0.01, np.float32))
    plain = np.asarray(hio.moving_rows(sharp_map, cloud, pose))
    assert plain[:60].sum() > 30
    assert not np.asarray(hio.moving_rows(sharp_map, cloud, pose, robot=robot)).any()
    find = jax.jit(
        lambda centers: hio.moving_rows(sharp_map, cloud, pose, robot=(centers, robot[1]))
    )
    assert not np.asarray(find(jnp.asarray(centers))).any()
    np.testing.assert_array_equal(find(jnp.asarray(centers) + 9), plain)


def test_stray_returns_are_not_moving(sharp_map):
    """A narrow cone of returns on a wall, and ten in free space: alone, or at one range."""
    ahead = np.random.default_rng(0).uniform(-0.02, 0.02, (250, 3)).astype(np.float32)
    ahead[:, 0] = 1
    cloud, share = np.float32(HALF[0]) * ahead, np.ones((250, 1), np.float32)
    for together in (False, True):
        share[:10, 0] = 0.45 if together else np.geomspace(0.25, 0.6, 10)
        thing = share * cloud
        moving = np.asarray(hio.moving_rows(sharp_map, thing, np.eye(4)))
        assert not moving[10:].any()
        assert moving[:10].sum() == 10 * together
        after = hio.update(sharp_map, thing, np.eye(4))
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
    with pytest.raises(ValueError, match="robot radii has values"):
        hio.moving_rows(sharp_map, cloud, pose, robot=(cloud[:2], [-1, 1]))
