"""Frames whose poses are predicted: refined, fused, or flagged and left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import (
    BOX_FRONT_X,
    CONFIG,
    HALF,
    arrays_equal,
    cloud_with_box,
    distances,
    map_of_room,
    room_cloud,
)
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio

COUNT = 300


def moved(pose, translation, turn):
    result = np.array(pose, float)
    result[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ result[:3, :3]
    result[:3, 3] += translation
    return result.astype(np.float32)


def frame():
    """A cloud, its pose, and a prediction that is off."""
    cloud, pose = room_cloud(70, COUNT, 0.3, (0.1, 0.05, 0.0))
    return cloud, pose, moved(pose, [0.02, -0.015, 0.01], [0.01, 0.0, -0.02])


@jax.jit
def track_all(state, clouds, poses):
    return jax.lax.scan(lambda state, frame: hio.track(state, *frame), state, (clouds, poses))


def foreign():
    """A cloud of another place."""
    return np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)


def test_a_frame_is_fused_at_its_refined_pose(sharp_map):
    cloud, pose, predicted = frame()
    state, found = hio.track(sharp_map, cloud, predicted)
    assert bool(found.converged)
    assert np.linalg.norm(np.asarray(found.pose)[:3, 3] - pose[:3, 3]) < 0.01
    assert int(state.updates) == int(sharp_map.updates) + 1
    assert int(state.report.update_flags) & hio.Flag.NOT_REGISTERED == 0
    prior = predicted, 0.05**2 * np.eye(6)
    refined = hio.refine_pose(sharp_map, cloud, predicted, prior, reach_m=0.2)
    for part, expected in zip(found, refined, strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-5)
    assert arrays_equal(state, hio.update(sharp_map, cloud, found.pose))


def test_a_frame_of_another_place_changes_nothing_but_the_flags(sharp_map):
    _, pose, _ = frame()
    state, found = hio.track(sharp_map, foreign(), pose)
    assert not bool(found.converged)
    np.testing.assert_array_equal(found.pose, pose)
    assert np.diag(found.covariance).min() >= 100**2
    assert hio.Flag(state.report.update_flags) == hio.Flag.NOT_REGISTERED
    same = state.replace(report=sharp_map.report)
    assert arrays_equal(same, sharp_map)


@pytest.mark.parametrize("shift", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (-0.7, 0, 0)])
def test_a_prediction_whose_rays_go_through_a_wall_is_refused(sharp_map, shift):
    """Most returns fit: those on the walls along the shift, the floor and the ceiling."""
    cloud, pose = room_cloud(100, COUNT)
    state, found = hio.track(sharp_map, cloud, moved(pose, shift, np.zeros(3)))
    assert float(found.inliers) > 0.7
    assert not bool(found.converged)
    assert int(state.updates) == int(sharp_map.updates)


@pytest.mark.parametrize("seed", range(3))
def test_few_returns_correct_a_prediction_that_is_three_deviations_off(sharp_map, seed):
    cloud, pose = room_cloud(100 + seed, 20 * COUNT, 0.3, (0.1, 0.05, 0.0))
    along_x = np.abs(cloud @ pose[:3, :3].T + pose[:3, 3])[:, 0] > HALF[0] - 1e-3
    few = COUNT // 10
    rows = *np.flatnonzero(~along_x)[: COUNT - few], *np.flatnonzero(along_x)[:few]
    _, found = hio.track(sharp_map, cloud[np.array(rows)], moved(pose, [0.14, 0, 0], np.zeros(3)))
    assert bool(found.converged)
    assert np.linalg.norm(np.asarray(found.pose)[:3, 3] - pose[:3, 3]) < 0.01


def test_something_that_leaves_is_seen_gone(empty_map):
    """At first a seventh of the rays goes through what the map takes for solid."""
    place = np.array([[BOX_FRONT_X + 0.15, 0.05 * k, 0.0] for k in range(-3, 4)])
    state = empty_map
    for seed in range(20):
        state, _ = hio.track(state, *cloud_with_box(seed, COUNT))
    assert distances(hio.snapshot(state), place).max() < 0
    for seed in range(20, 26):
        cloud, pose = room_cloud(seed, COUNT)
        state, found = hio.track(state, cloud, moved(pose, [0.02, -0.01, 0], [0, 0, 0.01]))
        assert bool(found.converged)
    assert distances(hio.snapshot(state), place).min() > 0.1


def test_the_first_frame_is_fused_as_predicted(empty_map):
    cloud, _, predicted = frame()
    state, found = hio.track(empty_map, cloud, predicted)
    assert bool(found.converged)
    np.testing.assert_array_equal(found.pose, predicted)
    np.testing.assert_array_equal(found.covariance, 0)
    assert arrays_equal(state, hio.update(empty_map, cloud, predicted))
    sure = (1e-4 * np.eye(6)).astype(np.float32)
    _, found = hio.track(empty_map, cloud, predicted, (predicted, sure))
    np.testing.assert_array_equal(found.covariance, sure)


def test_a_young_map_takes_what_it_cannot_judge(empty_map):
    state = empty_map
    unknown = 100**2 * np.eye(6)
    flags = [hio.Flag(0), *4 * [hio.Flag.FUSED_AS_PREDICTED], hio.Flag.NOT_REGISTERED]
    for k, flag in enumerate(flags):
        state, found = hio.track(state, foreign(), np.eye(4))
        assert bool(found.converged) == (k == 0)
        np.testing.assert_allclose(found.covariance, unknown if k else 0 * unknown)
        assert hio.Flag(int(state.report.update_flags)) & ~hio.Flag.POINTS_OUTSIDE == flag
    assert int(state.updates) == 5
    assert hio.Flag.FUSED_AS_PREDICTED in hio.Flag(int(state.report.flags))


def test_a_young_map_takes_no_cloud_that_update_refuses(empty_map):
    cloud, pose, _ = frame()
    frames = [(cloud, np.full((4, 4), np.nan)), (cloud, np.diag([1, 1, -1, 1]))]
    frames += [(np.zeros_like(cloud), pose), (cloud, pose)]
    clouds, poses = (np.stack(part).astype(np.float32) for part in zip(*frames, strict=True))
    state, found = track_all(empty_map, clouds, poses)
    np.testing.assert_array_equal(found.converged, [False, False, False, True])
    unknown = 100**2 * np.eye(6)
    np.testing.assert_allclose(found.covariance, [unknown, unknown, unknown, 0 * unknown])
    assert int(state.updates) == 1


def test_scan_and_one_frame_after_another_agree(sharp_map):
    frames = [room_cloud(i, COUNT, 0.05 * i, (0.02 * i, 0.01 * i, 0.0)) for i in range(4)]
    clouds = np.stack([cloud for cloud, _ in frames])
    clouds[1] = foreign()
    heights = clouds[3] @ frames[3][1][2, :3]
    clouds[3][heights > heights.min() + 0.01] = np.nan  # of a floor alone, the prediction decides
    poses = np.stack([moved(pose, [0.01, 0, 0], [0, 0, 0.01]) for _, pose in frames])
    state, founds = sharp_map, []
    for cloud, pose in zip(clouds, poses, strict=True):
        state, found = hio.track(state, cloud, pose)
        founds.append(found)
    assert [bool(found.converged) for found in founds] == [True, False, True, True]

    after, scanned = track_all(sharp_map, clouds, poses)
    np.testing.assert_array_equal(scanned.converged, [found.converged for found in founds])
    for k, found in enumerate(founds):
        # Whole-voxel steps of the field make poses rest within a millimeter, not at one point.
        np.testing.assert_allclose(scanned.pose[k], found.pose, atol=1e-3)
    deviation = np.sqrt(np.diag(founds[3].covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(scanned.covariance[3])), deviation, rtol=0.05)
    assert int(after.updates) == int(state.updates) == int(sharp_map.updates) + 3
    assert int(after.report.flags) == int(state.report.flags)


ARM_SENSOR = np.array([[0.3, 0.05, 0.0], [0.42, 0.05, 0.05]])  # m
ARM_RADII = np.array([0.06, 0.05], np.float32)


def frame_with_an_arm(share):
    """A frame of which a share of the returns is on the robot's own arm, their mask, the robot."""
    cloud, pose, predicted = frame()
    on_arm = np.arange(COUNT) < share * COUNT
    rng = np.random.default_rng(1)
    offsets = rng.normal(size=(COUNT, 3))
    offsets *= 1.1 * ARM_RADII[0] / np.linalg.norm(offsets, axis=1, keepdims=True)
    covered = np.where(on_arm[:, None], ARM_SENSOR[0] + offsets, cloud).astype(np.float32)
    centers = ARM_SENSOR @ predicted[:3, :3].T + predicted[:3, 3]
    return covered, on_arm, pose, predicted, (centers.astype(np.float32), ARM_RADII)


def test_returns_on_the_robot_neither_register_nor_map(sharp_map):
    covered, on_arm, pose, predicted, robot = frame_with_an_arm(0.5)
    _, misled = hio.track(sharp_map, covered, predicted)
    assert not bool(misled.converged)
    state, found = hio.track(sharp_map, covered, predicted, robot=robot)
    assert bool(found.converged)
    assert np.linalg.norm(np.asarray(found.pose)[:3, 3] - pose[:3, 3]) < 0.01
    without = np.where(on_arm[:, None], np.nan, covered)
    away = robot[0] + 50, robot[1]
    expected, alone = hio.track(sharp_map, without, predicted, robot=away)
    for part, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(part, other)
    assert arrays_equal(state.grid, expected.grid)


@pytest.mark.long
def test_a_robot_inside_jit(sharp_map):
    covered, _, _, predicted, robot = frame_with_an_arm(0.5)
    state, found = hio.track(sharp_map, covered, predicted, robot=robot)
    after, jitted = jax.jit(hio.track)(sharp_map, covered, predicted, robot=robot)
    assert bool(jitted.converged)
    np.testing.assert_allclose(jitted.pose, found.pose, atol=1e-3)
    assert int(after.report.points_used) == int(state.report.points_used)


@pytest.mark.parametrize("wrong", [np.nan, -1.0, 6.0])
@pytest.mark.long
def test_inside_jit_a_robot_of_wrong_radii_registers_nothing(sharp_map, wrong):
    cloud, _, predicted = frame()
    robot = np.full((2, 3), 50, np.float32), np.full(2, wrong, np.float32)
    state, found = jax.jit(hio.track)(sharp_map, cloud, predicted, robot=robot)
    assert not bool(found.converged)
    assert hio.Flag.BAD_ARGUMENT in hio.Flag(state.report.update_flags)
    assert int(state.updates) == int(sharp_map.updates)


def test_few_returns_beside_the_robot_are_not_drawn_away(sharp_map):
    """A cloud that is larger than `max_points`, and nearly all of it on the arm."""
    cloud, pose = room_cloud(100, 20 * COUNT, 0.3, (0.1, 0.05, 0.0))
    predicted = moved(pose, [0.02, -0.015, 0.01], [0.01, 0.0, -0.02])
    cloud[: int(19.5 * COUNT)] = ARM_SENSOR[0]
    centers = ARM_SENSOR @ predicted[:3, :3].T + predicted[:3, 3]
    state, found = hio.track(sharp_map, cloud, predicted, robot=(centers, ARM_RADII))
    assert bool(found.converged)
    assert np.linalg.norm(np.asarray(found.pose)[:3, 3] - pose[:3, 3]) < 0.002
    assert int(state.report.points_used) > 0.3 * COUNT


def test_the_robot_moves_with_the_pose(sharp_map):
    """The prediction is so far off that spheres that stay there do not cover the arm."""
    covered, _, pose, _, _ = frame_with_an_arm(0.2)
    predicted = moved(pose, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    centers = (ARM_SENSOR @ predicted[:3, :3].T + predicted[:3, 3]).astype(np.float32)
    state, found = hio.track(sharp_map, covered, predicted, robot=(centers, ARM_RADII))
    assert bool(found.converged)
    arm_world = ARM_SENSOR @ np.asarray(found.pose)[:3, :3].T + np.asarray(found.pose)[:3, 3]
    right = (arm_world.astype(np.float32), ARM_RADII)
    used = int(hio.update(sharp_map, covered, found.pose, robot=right).report.points_used)
    assert int(state.report.points_used) == used < COUNT
    stayed = hio.update(sharp_map, covered, found.pose, robot=(centers, ARM_RADII))
    assert int(stayed.report.points_used) > used
    assert float(hio.sdf(state, arm_world[0])) > 0.1


def test_a_view_of_the_robot_alone_is_not_registered(sharp_map):
    covered, _, _, predicted, robot = frame_with_an_arm(1.0)
    state, found = hio.track(sharp_map, covered, predicted, robot=robot)
    assert not bool(found.converged)
    assert hio.Flag.NOT_REGISTERED in hio.Flag(state.report.update_flags)
    assert int(state.updates) == int(sharp_map.updates)


@pytest.mark.long
def test_a_stack_of_maps_is_traced_by_vmap(empty_map):
    cloud, _, predicted = frame()
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    both = (np.stack([cloud, cloud]), np.stack([predicted, predicted]))
    state, found = jax.eval_shape(jax.vmap(hio.track), stack, *both)
    assert found.pose.shape == (2, 4, 4)
    assert state.updates.shape == (2,)


def test_a_glitch_of_the_predictions_leaves_the_map_as_without_it():
    """Five frames in a row whose poses jump out of the room's reach."""
    state = map_of_room(CONFIG, jax.random.key(0), 12, COUNT)
    before = state
    for i in range(5):
        cloud, pose = room_cloud(90 + i, COUNT)
        state, found = hio.track(state, cloud, moved(pose, [0.6, 0.5, 0.3], [0, 0, 0.8]))
        assert not bool(found.converged)
    assert arrays_equal(state.replace(report=before.report), before)


@pytest.mark.parametrize("seed", range(3))
def test_a_prediction_is_the_motion_between_two_poses(seed):
    rng = np.random.default_rng(seed)
    poses = [moved(np.eye(4), rng.normal(size=3), rng.normal(size=3)) for _ in range(3)]
    pose, before, after = (each.astype(float) for each in poses)
    expected = pose @ np.linalg.inv(before) @ after
    np.testing.assert_allclose(hio.predict_pose(*poses), expected, atol=2e-6)
    np.testing.assert_allclose(jax.jit(hio.predict_pose)(*poses), expected, atol=2e-6)
    np.testing.assert_allclose(hio.predict_pose(poses[0], poses[1], poses[1]), pose, atol=1e-6)


def test_a_long_chain_of_predictions_stays_rigid():
    """Extrapolation would more than double what a rotation is off, in each step."""
    start = np.eye(4, dtype=np.float32)
    second = moved(start, [0.1, 0.0, 0.02], [0.01, -0.02, 0.1])

    def step(poses, _):
        before, last = poses
        return (last, hio.predict_pose(last, before, last)), None

    (_, last), _ = jax.lax.scan(step, (start, second), None, 1000)
    rotation = np.asarray(last, float)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert np.isfinite(np.asarray(last)).all()


BAD = np.eye(4)
BAD[0, 0] = 2


def test_wrong_input_is_named(empty_map):
    cloud, pose, _ = frame()
    for arguments, message in [
        ((3, cloud, pose), "state is int"),
        ((empty_map, cloud[:, :2], pose), "cloud has shape"),
        ((empty_map, cloud, BAD), "pose is not rigid"),
        ((empty_map, cloud, pose, np.eye(4)), "prior is"),
    ]:
        with pytest.raises(ValueError, match=message):
            hio.track(*arguments)
    with pytest.raises(ValueError, match="robot has centers of shape"):
        hio.track(empty_map, cloud, pose, robot=(np.zeros((2, 3)), np.zeros(3)))
    robot = np.zeros((2, 3)), np.zeros(2)
    with pytest.raises(ValueError, match="prior has a mean of shape"):
        hio.track(empty_map, cloud, pose, (np.eye(3), np.eye(6)), robot=robot)
    with pytest.raises(ValueError, match=r"reach_m is 0, expected >= 0\.001"):
        hio.track(empty_map, cloud, pose, reach_m=0)
    with pytest.raises(ValueError, match="before: pose is not rigid"):
        hio.predict_pose(pose, BAD, pose)
    with pytest.raises(ValueError, match="after: pose has shape"):
        hio.predict_pose(pose, pose, np.eye(3))
    with pytest.raises(ValueError, match=r"after has shape \(3, 3\), expected \(4, 4\)"):
        jax.jit(hio.predict_pose)(pose, pose, np.eye(3))
