"""Whether a cloud fits a map at a pose: what a floor hides, and what walls forbid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import HALF, cloud_with_box, room_cloud
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.grid.geometry import voxel_center
from hiosdf_jax._src.mapping.registration.comparing import make_rows
from hiosdf_jax._src.mapping.registration.judging import judge
from hiosdf_jax._src.mapping.registration.matching import find_blocked
from hiosdf_jax._src.state.pytrees import field_of

COUNT = 1000


@pytest.fixture(scope="module")
def field(sharp_map):
    return field_of(sharp_map)


@jax.jit
def judged(field, cloud, some, pose):
    return judge(field, make_rows(cloud, some, (jnp.float32(0.01), jnp.float32(0))), pose)


def verdict(field, cloud, pose):
    return judged(field, cloud, np.ones(len(cloud), bool), pose)


@jax.jit
def compiled_blocked(field, pose, cloud, some):
    return find_blocked(field, pose, cloud, some)


def blocked_rays(field, pose, cloud, some):
    """Which rays are blocked, of up to 200 by one compilation."""
    padded, rays = np.zeros((200, 3), np.float32), np.zeros(200, bool)
    padded[: len(cloud)], rays[: len(cloud)] = cloud, some
    return np.asarray(compiled_blocked(field, pose, padded, rays))[: len(cloud)]


def returns_of(axes, count, seed=0):
    """Returns of a sensor in the middle of the room: on the walls across some axes alone."""
    cloud, pose = room_cloud(seed, 40 * count)
    kept = np.argmin(HALF - np.abs(cloud), axis=1)
    cloud = cloud[np.isin(kept, axes)]
    # Not near corners, where both walls are near.
    near = np.sort(HALF - np.abs(cloud), axis=1)[:, 1]
    return cloud[near > 0.15][:count], pose


def shifted(pose, way):
    result = np.array(pose)
    result[:3, 3] += way
    return result


def test_a_right_pose_fits_and_a_wrong_one_does_not(field):
    cloud, pose = room_cloud(1, COUNT)
    found = verdict(field, cloud, pose)
    assert bool(found.fits)
    assert float(found.inliers) > 0.95
    assert not bool(verdict(field, cloud, shifted(pose, [0.6, 0.5, 0.3])).fits)


@pytest.mark.parametrize("way", [-0.5, 0.5])
def test_a_floor_does_not_outweigh_walls_that_contradict(field, way):
    """Most returns lie on floor and ceiling, which fit wherever the sensor is."""
    flat, pose = returns_of([2], 820)
    ends, _ = returns_of([0], 180)
    cloud = np.concatenate([flat, ends])
    assert bool(verdict(field, cloud, pose).fits)
    wrong = verdict(field, cloud, shifted(pose, [way, 0, 0]))
    assert float(wrong.inliers) > 0.7  # a test of these alone would take the pose
    assert not bool(wrong.fits)


def test_rays_through_a_wall_count_where_nothing_else_contradicts(field):
    """The end of the room would lie half a meter behind its wall, in unseen space."""
    flat, pose = returns_of([2], 820)
    ends, _ = returns_of([0], 1000)
    cloud = np.concatenate([flat, ends[ends[:, 0] > 0][:180]])
    assert bool(verdict(field, cloud, pose).fits)
    wrong = verdict(field, cloud, shifted(pose, [0.5, 0, 0]))
    assert float(wrong.inliers) > 0.95
    assert not bool(wrong.fits)


@pytest.mark.parametrize("share", [0.1, 0.18])
@pytest.mark.parametrize("way", [0.3, 0.4, 0.5])
def test_rays_through_the_end_of_a_tube_refuse_a_pose(field, share, way):
    """Nothing but the end holds the pose along the tube, and it would lie in unseen space."""
    sides, pose = returns_of([1, 2], round((1 - share) * COUNT))
    ends, _ = returns_of([0], COUNT)
    cloud = np.concatenate([sides, ends[ends[:, 0] > 0][: round(share * COUNT)]])
    assert bool(verdict(field, cloud, pose).fits)
    assert not bool(verdict(field, cloud, shifted(pose, [way, 0, 0])).fits)


def test_a_view_of_a_floor_alone_fits_in_spite_of_outliers(field):
    flat, pose = returns_of([2], COUNT)
    flat[:30] *= 0.5
    assert bool(verdict(field, flat, pose).fits)


def test_rows_without_returns_change_nothing(field):
    cloud, pose = room_cloud(4, 300)
    short = verdict(field, cloud, pose)
    padded = np.zeros((COUNT, 3), np.float32)
    padded[:300] = cloud
    found = judged(field, padded, np.arange(COUNT) < 300, pose)
    np.testing.assert_allclose(np.stack(found), np.stack(short), rtol=1e-6)


def test_things_that_are_new_leave_a_right_pose_right(field):
    """A quarter of the walls is hidden by something in front of them."""
    cloud, pose = room_cloud(2, COUNT)
    hidden = cloud[:, 0] > np.quantile(cloud[:, 0], 0.75)
    cloud[hidden] *= 0.4
    assert bool(verdict(field, cloud, pose).fits)


def test_rays_that_would_have_passed_walls_are_found(field):
    cloud, pose = room_cloud(3, 200)
    pose = shifted(pose, [0.1, -0.05, 0.05])
    cloud = cloud - np.asarray(pose[:3, 3])  # now of a sensor there
    some = np.arange(len(cloud)) >= 20
    longer = cloud * (1 + 0.5 / np.linalg.norm(cloud, axis=1, keepdims=True))
    shorter = cloud * 0.7
    assert not blocked_rays(field, pose, shorter, some).any()
    assert not blocked_rays(field, pose, cloud, some).any()
    blocked = blocked_rays(field, pose, longer, some)
    assert not blocked[~some].any()
    # Near corners the ray may pass the wall where no scan has looked.
    assert blocked[some].mean() > 0.7


def test_a_wall_blocks_no_ray_that_comes_from_behind(field):
    """The next room is unseen: nobody knows how thick the wall is."""
    cloud, pose = room_cloud(5, 200)
    ends = cloud[np.argmin(HALF - np.abs(cloud), axis=1) == 0]
    ends = ends[ends[:, 0] > 0]
    for way in (0.02, 0.06):
        behind = np.array([HALF[0] + 2.0, 0, 0], np.float32)
        to_back = ends + np.array([way, 0, 0], np.float32) - behind
        assert not blocked_rays(field, shifted(pose, behind), to_back, True).any()


DOOR_X, DOOR_HALF = 0.25, 0.35


def voxel_centers(config):
    """(X, Y, Z, 3) m."""
    index = np.moveaxis(np.indices(config.grid_shape), 0, -1)
    return np.asarray(voxel_center(config, jnp.asarray(index)))


def with_sdf(field, sdf):
    derived = field.surface.derived.replace(sdf=np.asarray(sdf, np.float16))
    return field.replace(surface=field.surface.replace(derived=derived))


def with_door(field):
    """A wall at x = DOOR_X, seen from one side: behind it all is guessed solid beside the door."""
    x, y, _ = np.moveaxis(voxel_centers(field.config), -1, 0)
    to_jamb = np.hypot(DOOR_X - x, DOOR_HALF - np.abs(y))
    beside = np.abs(y) > DOOR_HALF
    return with_sdf(field, np.where(beside, DOOR_X - x, to_jamb))


def test_a_ray_through_a_door_is_not_blocked_by_the_solid_beside_it(field):
    field, origin = with_door(field), np.array([-0.8, 0, 0.05])
    pose = shifted(np.eye(4, dtype=np.float32), origin)

    def rays_through(low, high, times):
        """Rays through the plane of the wall at some |y|, that many times as long."""
        y = np.linspace(low, high, 10)
        ends = np.stack([np.full(20, DOOR_X), [*y, *-y], np.zeros(20)], axis=1)
        return (times * (ends - origin)).astype(np.float32)

    every = np.ones(20, bool)
    through_door = rays_through(0.2, 0.25, 1.65)
    assert np.all(np.abs(through_door[:, 1]) > DOOR_HALF - 0.05)
    assert not blocked_rays(field, pose, through_door, every).any()
    assert blocked_rays(field, pose, rays_through(0.47, 0.65, 1.4), every).all()


def blocked_slowly(config, sdf, pose, point):
    """Walks along a ray: whether it is blocked, and whether rounding could decide that."""
    offset = pose[:3, :3] @ point
    distance, size = np.linalg.norm(offset), config.voxel_size
    reach = max(distance - 1.5 * size, 0)
    inside, before, close = False, None, False
    for k in range(64):
        place = (pose[:3, 3] + offset / distance * reach * (k + 0.5) / 64) / size
        index = np.floor(place).astype(int) - config.corner_index
        close |= bool(np.min(np.abs(place - np.round(place))) < 1e-4)
        known = np.all((index >= 0) & (index < config.grid_shape))
        now = float(sdf[tuple(index)]) if known else np.inf
        if now > 0:
            inside = True
        elif before is None or before - now > reach / 64 + 2**0.5 * size:
            inside = False
        if inside and now < -size:
            return True, close
        before = now
    return False, close


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_blocked_rays_are_those_of_a_walk_along_each_ray(field, seed):
    rng = np.random.default_rng(seed)
    centers = voxel_centers(field.config)

    def plane():
        normal = rng.normal(size=3)
        return centers @ (normal / np.linalg.norm(normal)) + rng.uniform(-0.3, 0.8)

    sdf = np.where(plane() > 0, plane(), plane()).astype(np.float16)
    pose = shifted(np.eye(4, dtype=np.float32), rng.uniform(-0.7, 0.7, 3))
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    cloud = (rng.normal(size=(200, 3)) * 0.8).astype(np.float32)
    found = blocked_rays(with_sdf(field, sdf), pose, cloud, np.ones(200, bool))
    walked = [blocked_slowly(field.config, sdf, pose.astype(float), point) for point in cloud]
    expected, close = np.transpose(walked)
    np.testing.assert_array_equal(found[~close], expected[~close])


def test_something_that_is_gone_refuses_no_right_pose(empty_map):
    """It hid a seventh of the view. A map that refused the pose would never see it gone."""
    state = empty_map
    for seed in range(30):
        state = hio.update(state, *cloud_with_box(seed, 300))
    cloud, pose = room_cloud(6, COUNT)
    blocked = blocked_rays(field_of(state), pose, cloud[:200], np.ones(200, bool))
    assert blocked.mean() > 0.12
    assert bool(verdict(field_of(state), cloud, pose).fits)
