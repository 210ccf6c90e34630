"""Odometry that drifts: its scale and turn are estimated while frames are fused."""

import itertools
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal, room_cloud
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import odometry as filtering

COUNT = 300
SCALE, TURN = -0.02, np.radians([0.05, -0.1, 0.15])
DEVIATION = (3e-4, 2.5e-3), (5e-5, 2e-4, 2.5e-3)
NO_FLAGS = jnp.uint32(0)


def rotation(vector):
    return Rotation.from_rotvec(vector).as_matrix()


def walk(seed, count=60):
    """Exact poses of a wandering sensor."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    turn = np.zeros(3)
    for _ in range(count - 1):
        step = np.eye(4)
        turn = 0.8 * turn + 0.02 * rng.normal(size=3)
        step[:3, :3] = rotation(turn)
        step[:3, 3] = [0.2, 0.02 * rng.normal(), 0.02 * rng.normal()]
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def odometry_of(poses):
    """Their odometry, from which a scale and a turn per meter are missing."""
    given = [np.eye(4)]
    for before, after in itertools.pairwise(poses):
        step = np.linalg.inv(before) @ after
        step[:3, 3] /= 1 + SCALE
        step[:3, :3] = step[:3, :3] @ rotation(-np.linalg.norm(step[:3, 3]) * TURN)
        given.append(given[-1] @ step)
    return np.stack(given)


def registration(pose, covariance=1e-6):
    return hio.Registration(
        jnp.asarray(pose, jnp.float32),
        covariance * jnp.eye(6, dtype=jnp.float32),
        jnp.float32(0.001),
        jnp.float32(0.9),
        jnp.bool_(True),
    )


def away(pose, exact):
    """Meters and radians between two poses."""
    turn = Rotation.from_matrix(np.asarray(pose, float)[:3, :3] @ exact[:3, :3].T)
    return np.linalg.norm(np.asarray(pose)[:3, 3] - exact[:3, 3]), turn.magnitude()


def noisy(pose, rng, noise_m=0.003, noise_rad=0.001):
    result = np.array(pose)
    result[:3, 3] += noise_m * rng.normal(size=3)
    result[:3, :3] = rotation(noise_rad * rng.normal(size=3)) @ result[:3, :3]
    return result


def step(odometry, given, found, registered=True):
    """Predicts and corrects; returns the odometry and the registration."""
    odometry = filtering._predict_jit(odometry, jnp.asarray(given, jnp.float32))
    corrected, found, _ = filtering._correct_jit(odometry, found, jnp.bool_(registered), NO_FLAGS)
    return corrected, found


class Slow:
    """The same filter in float64, with derivatives by finite differences."""

    def __init__(self, pose, given):
        self.pose, self.given = pose, given
        self.mean = np.zeros(10)  # of the errors of the pose, which are kept 0; scale and turn
        variance = [0] * 6 + [filtering._SCALE**2] + [filtering._TURN**2] * 3
        self.covariance = np.diag(np.array(variance, float))

    def moved(self, mean, given):
        """The next pose if the errors are `mean`, and the motion."""
        motion = np.linalg.inv(self.given) @ given
        length = np.linalg.norm(motion[:3, 3])
        motion[:3, 3] *= 1 + mean[6]
        motion[:3, :3] = motion[:3, :3] @ rotation(length * mean[7:])
        start = np.array(self.pose)
        start[:3, 3] += mean[:3]
        start[:3, :3] = rotation(mean[3:6]) @ start[:3, :3]
        return start @ motion, length, Rotation.from_matrix(motion[:3, :3]).magnitude()

    def predict(self, given):
        after, length, angle = self.moved(self.mean, given)
        carried = np.eye(10)
        for k in range(10):
            changed, *_ = self.moved(self.mean + 1e-6 * np.eye(10)[k], given)
            carried[:3, k] = (changed - after)[:3, 3] / 1e-6
            turn = Rotation.from_matrix(changed[:3, :3] @ after[:3, :3].T).as_rotvec()
            carried[3:6, k] = turn / 1e-6
        (rest_m, per_way), (rest_rad, turn_per_way, per_turn) = DEVIATION
        deviation = [rest_m + per_way * length] * 3
        deviation += [rest_rad + turn_per_way * length + per_turn * angle] * 3
        deviation += list(
            np.sqrt(length) * np.array([filtering._SCALE_WALK] + 3 * [filtering._TURN_WALK])
        )
        self.covariance = carried @ self.covariance @ carried.T + np.diag(np.square(deviation))
        self.pose, self.given = after, given

    def correct(self, found, variance):
        turn = Rotation.from_matrix(found[:3, :3] @ self.pose[:3, :3].T).as_rotvec()
        surprise = np.concatenate([found[:3, 3] - self.pose[:3, 3], turn])
        own = filtering._SHARED * np.repeat(np.square(filtering._REGISTERED), 3) + variance
        gain = self.covariance[:, :6] @ np.linalg.inv(self.covariance[:6, :6] + np.diag(own))
        correction = gain @ surprise
        self.covariance = self.covariance - gain @ self.covariance[:6]
        self.pose = np.array(self.pose)
        self.pose[:3, 3] += correction[:3]
        self.pose[:3, :3] = rotation(correction[3:6]) @ self.pose[:3, :3]
        self.mean[6:] += correction[6:]


@pytest.mark.parametrize("seed", range(2))
def test_it_is_the_kalman_filter(seed):
    """Against float64, finite differences and inverse matrices."""
    rng = np.random.default_rng(seed)
    poses = walk(seed)
    given = odometry_of(poses)
    odometry = hio.start_odometry(poses[0], given[0])
    slow = Slow(poses[0], given[0])
    for pose, at in zip(poses[1:], given[1:], strict=True):
        seen = noisy(pose, rng)
        odometry, _ = step(odometry, at, registration(seen))
        slow.predict(at)
        slow.correct(seen, 1e-6)
        assert away(odometry.pose, slow.pose)[0] < 2e-4
    np.testing.assert_allclose(odometry.scale, slow.mean[6], atol=2e-4)
    np.testing.assert_allclose(odometry.turn, slow.mean[7:], atol=2e-5)
    deviation = np.sqrt(np.diag(slow.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(odometry.covariance)), deviation, rtol=0.02)


def test_it_finds_the_scale_and_the_turn():
    rng = np.random.default_rng(0)
    poses = walk(0, 400)
    given = odometry_of(poses)
    odometry = hio.start_odometry(poses[0], given[0])
    for pose, at in zip(poses[1:], given[1:], strict=True):
        odometry, _ = step(odometry, at, registration(noisy(pose, rng)))
    np.testing.assert_allclose(odometry.scale, SCALE, atol=0.001)
    np.testing.assert_allclose(odometry.turn, TURN, atol=np.radians(0.02))
    assert away(odometry.pose, poses[-1])[0] < 0.01
    assert away(given[-1], poses[-1])[0] > 1.0


def straight(count, way=0.1):
    poses = np.stack([np.eye(4)] * count)
    poses[:, 0, 3] = way * np.arange(count)
    return poses


def test_one_wrong_registration_is_refused():
    poses = straight(40)
    odometry = hio.start_odometry(poses[0], poses[0])
    for pose in poses[1:-2]:
        odometry, found = step(odometry, pose, registration(pose))
        assert bool(found.converged)
    wrong = np.array(poses[-2])
    wrong[1, 3] += 0.1
    odometry, found = step(odometry, poses[-2], registration(wrong))
    assert not bool(found.converged)
    assert away(odometry.pose, poses[-2])[0] < 0.001
    odometry, found = step(odometry, poses[-1], registration(poses[-1]))
    assert bool(found.converged)


@pytest.mark.parametrize("slip_m", [0.1, 0.2])
def test_after_wheels_slipped_it_comes_back(slip_m):
    """What is fused meanwhile is no farther off than `track`'s own predictions may be."""
    poses = straight(150)
    given = np.array(poses)
    given[50:, 0, 3] += slip_m
    odometry = hio.start_odometry(poses[0], given[0])
    refused = []
    for k in range(1, len(poses)):
        odometry, found = step(odometry, given[k], registration(poses[k]))
        if not bool(found.converged):
            refused.append(k)
        else:
            assert away(odometry.pose, poses[k])[0] < 0.05
    assert refused[0] == 50
    assert 5 <= len(refused) <= 25
    assert away(odometry.pose, poses[-1])[0] < 0.01


def test_without_registration_odometry_goes_on():
    poses = straight(3)
    odometry = hio.start_odometry(poses[0], poses[0])
    lost = registration(poses[0], 100.0**2)._replace(converged=jnp.bool_(False))
    after, found = step(odometry, poses[1], lost, registered=False)
    assert not bool(found.converged)
    np.testing.assert_allclose(after.pose, poses[1], atol=1e-6)
    np.testing.assert_array_equal(found.covariance, lost.covariance)
    young = lost._replace(converged=jnp.bool_(True))  # a map that takes what it cannot judge
    after, found = step(odometry, poses[1], young, registered=False)
    assert bool(found.converged)
    np.testing.assert_allclose(found.pose, poses[1], atol=1e-6)


def test_free_directions_are_left_to_odometry():
    """In a corridor registration tells nothing of the way along it."""
    poses = straight(30)
    odometry = hio.start_odometry(poses[0], poses[0])
    variance = jnp.diag(jnp.array([100.0**2, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6], jnp.float32))
    for pose in poses[1:]:
        seen = np.array(pose)
        seen[0, 3] += 0.5
        seen[1, 3] += 0.004
        odometry, found = step(odometry, pose, registration(seen)._replace(covariance=variance))
        assert bool(found.converged)
    assert abs(float(odometry.pose[0, 3]) - poses[-1, 0, 3]) < 0.001
    assert abs(float(odometry.pose[1, 3]) - 0.004) < 0.003
    assert float(odometry.covariance[0, 0]) > float(odometry.covariance[1, 1])


def room_frames(count):
    frames = [room_cloud(i, COUNT, 0.05 * i, (0.02 * i, 0.01 * i, 0.0)) for i in range(count)]
    return np.stack([cloud for cloud, _ in frames]), np.stack([pose for _, pose in frames])


def test_a_frame_of_another_place_is_not_fused(sharp_map):
    clouds, poses = room_frames(4)
    clouds[1] = np.random.default_rng(0).normal(size=(COUNT, 3))  # of another place
    first = hio.start_odometry(poses[0], poses[0])
    state, odometry, converged = sharp_map, first, []
    for cloud, pose in zip(clouds, poses, strict=True):
        state, odometry, found = hio.track_odometry(state, cloud, odometry, pose)
        np.testing.assert_array_equal(found.pose, odometry.pose)
        converged.append(bool(found.converged))
        flag = int(state.report.update_flags) & hio.Flag.NOT_REGISTERED
        assert bool(flag) != converged[-1]
    assert converged == [True, False, True, True]

    def scanned(carry, frame):
        state, odometry, found = hio.track_odometry(carry[0], frame[0], carry[1], frame[1])
        return (state, odometry), found

    assert int(state.updates) == int(sharp_map.updates) + 3
    # `track` is run by scan elsewhere; compiling this takes as long.
    scan = jax.eval_shape(lambda *a: jax.lax.scan(scanned, *a), (sharp_map, first), (clouds, poses))
    assert scan[1].pose.shape == (4, 4, 4)


def test_a_frame_is_fused_at_the_corrected_pose(sharp_map):
    clouds, poses = room_frames(2)
    odometry = hio.start_odometry(poses[0], poses[0])
    state, odometry, found = hio.track_odometry(sharp_map, clouds[1], odometry, poses[1])
    assert bool(found.converged)
    assert away(found.pose, poses[1])[0] < 0.01
    assert arrays_equal(state, hio.update(sharp_map, clouds[1], odometry.pose))


def test_the_first_frame_is_fused_where_it_begins(empty_map):
    clouds, poses = room_frames(1)
    begin = np.eye(4, dtype=np.float32)
    odometry = hio.start_odometry(poses[0], begin)
    state, odometry, found = hio.track_odometry(empty_map, clouds[0], odometry, begin)
    assert bool(found.converged)
    np.testing.assert_allclose(found.pose, poses[0], atol=1e-6)
    assert int(state.updates) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.eye(3), np.eye(4)), "pose has shape"),
        ((np.eye(4), 2 * np.eye(4)), "given_pose"),
        ((np.eye(4), np.eye(4), 0.1), "motion_deviation"),
        ((np.eye(4), np.eye(4), ((0.1, 0.1), (0.1, 0.1))), "motion_deviation"),
        ((np.eye(4), np.eye(4), ((0.1, -0.1), (0.1, 0.1, 0.1))), "motion_deviation"),
    ],
)
def test_a_wrong_beginning_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        hio.start_odometry(*arguments)


def test_wrong_arguments_are_refused(empty_map):
    cloud = np.ones((COUNT, 3), np.float32)
    odometry = hio.start_odometry(np.eye(4), np.eye(4))
    with pytest.raises(ValueError, match="odometry is ndarray, expected"):
        hio.track_odometry(empty_map, cloud, cast(Any, np.eye(4)), np.eye(4))
    with pytest.raises(ValueError, match="given_pose"):
        hio.track_odometry(empty_map, cloud, odometry, np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="given_pose has shape"):
        jax.jit(hio.track_odometry)(empty_map, cloud, odometry, np.eye(3))
    with pytest.raises(ValueError, match="cloud"):
        hio.track_odometry(empty_map, cloud[:, :2], odometry, np.eye(4))
