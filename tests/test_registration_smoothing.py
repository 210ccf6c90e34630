"""Whole trajectories that keep their registered motion and stay near noisy given poses."""

import itertools
import warnings

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from poses import random_pose
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio

COVARIANCE = np.diag([0.01**2, 0.012**2, 0.02**2, 0.01**2, 0.02**2, 0.015**2])
EQUAL = np.diag([0.01**2] * 3 + [0.02**2] * 3)


def path(count):
    """A sensor that walks on a curve."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    along = np.arange(count) / 5
    poses[:, :3, 3] = np.stack([along, np.sin(along), 0.3 * np.cos(along)], axis=-1)
    turns = np.stack([0.1 * along, 0.05 * along, np.cos(along)], axis=-1)
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return poses


def noisy(poses, rng, meters, radians):
    result = np.array(poses)
    result[:, :3, 3] += meters * rng.normal(size=(len(poses), 3))
    turns = Rotation.from_rotvec(radians * rng.normal(size=(len(poses), 3)))
    result[:, :3, :3] = turns.as_matrix() @ result[:, :3, :3]
    return result


def drifting(poses, rng, meters, radians):
    """Composes the path again from noisy steps."""
    result = [poses[0]]
    for before, after in itertools.pairwise(poses):
        step = noisy((np.linalg.inv(before) @ after)[None], rng, meters, radians)[0]
        result.append(result[-1] @ step)
    return np.stack(result)


def errors(poses, exact):
    """Root mean square errors, m and rad."""
    way = np.linalg.norm(poses[:, :3, 3] - exact[:, :3, 3], axis=1)
    turns = Rotation.from_matrix(poses[:, :3, :3] @ exact[:, :3, :3].transpose(0, 2, 1))
    return np.sqrt(np.mean(way**2)), np.sqrt(np.mean(turns.magnitude() ** 2))


def test_smoothed_poses_are_better_than_the_given_and_the_registered_ones():
    rng = np.random.default_rng(0)
    exact = path(200)
    given_poses = noisy(exact, rng, 0.01, 0.01)
    registered = drifting(exact, rng, 0.002, 0.0005)
    smoothed = hio.smooth_poses(registered, given_poses, 0.01**2 * np.eye(6))
    assert smoothed.dtype == np.float32 and smoothed.shape == (200, 4, 4)
    for new, other in zip(errors(smoothed, exact), errors(given_poses, exact), strict=True):
        assert new < 0.5 * other
    for new, other in zip(errors(smoothed, exact), errors(registered, exact), strict=True):
        assert new < 0.7 * other


def moved(poses, motions):
    """Poses moved by motions (N, 6): m, and rad about the sensors."""
    result = np.array(poses, float)
    result[:, :3, 3] += motions[:, :3]
    turns = Rotation.from_rotvec(motions[:, 3:]).as_matrix()
    result[:, :3, :3] = turns @ result[:, :3, :3]
    return result


def cost(poses, registered, given_poses, covariance, deviation):
    """The documented cost, pose by pose."""
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    found = []
    for pose, mean in zip(poses, given_poses, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3] @ mean[:3, :3].T).as_rotvec()
        found.append(inverse @ np.concatenate([pose[:3, 3] - mean[:3, 3], turn]))
    for i in range(1, len(poses)):
        step = np.linalg.inv(poses[i - 1]) @ poses[i]
        wanted = np.linalg.inv(registered[i - 1]) @ registered[i]
        turn = Rotation.from_matrix(step[:3, :3] @ wanted[:3, :3].T).as_rotvec()
        away = np.concatenate([step[:3, 3] - wanted[:3, 3], turn])
        found.append(away / np.repeat(deviation, 3))
    return sum(12 * (np.sqrt(1 + each @ each / 6) - 1) for each in found)


@pytest.mark.parametrize("false_turn_deg", [0, 30])
def test_the_result_minimizes_the_documented_cost(false_turn_deg):
    """Against a search without derivatives; with a false registration, full steps find no rest."""
    rng = np.random.default_rng(1)
    exact, deviation = path(4), (0.003, 0.001)
    given_poses, registered = noisy(exact, rng, 0.01, 0.01), drifting(exact, rng, 0.004, 0.002)
    turn = Rotation.from_euler("z", false_turn_deg, degrees=True).as_matrix()
    registered[2, :3, :3] = turn @ registered[2, :3, :3]
    smoothed = hio.smooth_poses(
        registered, given_poses, COVARIANCE, motion_deviation=deviation
    ).astype(float)

    def cost_of(motions):
        near = moved(smoothed, motions.reshape(-1, 6) / 1000)
        return cost(near, registered, given_poses, COVARIANCE, deviation)

    found = minimize(cost_of, np.full(24, 3.0), method="BFGS", options={"gtol": 1e-7})
    np.testing.assert_allclose(moved(smoothed, found.x.reshape(-1, 6) / 1000), smoothed, atol=3e-5)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_smoothing_moves_with_the_world(seed):
    rng = np.random.default_rng(seed)
    exact, world = path(12), random_pose(rng, 20.0)
    given_poses, registered = noisy(exact, rng, 0.01, 0.02), drifting(exact, rng, 0.004, 0.001)
    smoothed = hio.smooth_poses(registered, given_poses, EQUAL)
    moved = hio.smooth_poses(world @ registered, world @ given_poses, EQUAL)
    np.testing.assert_allclose(moved, world @ smoothed, atol=5e-5)


def test_poses_that_agree_stay():
    poses = path(9)
    np.testing.assert_allclose(hio.smooth_poses(poses, poses, EQUAL), poses, atol=1e-6)


def test_a_frame_that_is_not_registered_takes_its_given_pose():
    rng = np.random.default_rng(2)
    exact = path(30)
    given_poses, registered = noisy(exact, rng, 0.01, 0.01), drifting(exact, rng, 1e-4, 1e-4)
    registered[10:20] = path(30)[0]  # lost for ten frames
    known = np.ones(30, bool)
    known[10:20] = False
    smoothed = hio.smooth_poses(registered, given_poses, EQUAL, known)
    np.testing.assert_allclose(smoothed[10:20], given_poses[10:20], atol=2e-4)
    assert errors(smoothed[:10], exact[:10])[0] < 0.01


def test_a_single_wild_given_pose_does_not_bend_the_path():
    exact = path(40)
    given_poses = np.array(exact)
    given_poses[20, :3, 3] += 1.0
    smoothed = hio.smooth_poses(exact, given_poses, EQUAL)
    assert np.linalg.norm(smoothed[:, :3, 3] - exact[:, :3, 3], axis=1).max() < 0.005


def test_poses_that_contradict_each_other_warn_or_rest():
    rng = np.random.default_rng(5)
    wild = np.stack([random_pose(rng) for _ in range(4)])
    other = np.stack([random_pose(rng) for _ in range(4)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        smoothed = hio.smooth_poses(wild, other, EQUAL)
    assert np.isfinite(smoothed).all()


def test_given_poses_of_unknown_accuracy_change_nothing():
    exact = path(100)
    given_poses = noisy(exact, np.random.default_rng(6), 0.01, 0.01)
    for variance in (1e6, 1e10, 1e16):
        smoothed = hio.smooth_poses(exact, given_poses, variance * np.eye(6))
        assert errors(smoothed[1:], exact[1:])[0] < 0.01


def test_a_covariance_may_be_singular_to_rounding():
    """100 m along a corridor that runs along no axis, and 1 cm across it."""
    turn = np.kron(np.eye(2), Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix())
    deviations = np.array([100, 0.01, 0.01, 0.01, 0.01, 0.01])
    oblique = (turn * deviations**2 @ turn.T).astype(np.float32)
    rng = np.random.default_rng(7)
    exact = path(60)
    given_poses, registered = noisy(exact, rng, 0.01, 0.01), drifting(exact, rng, 0.002, 0.0005)
    smoothed = hio.smooth_poses(registered, given_poses, oblique)
    way = (smoothed[:, :3, 3] - exact[:, :3, 3]) @ turn[:3, 1:3]
    assert np.sqrt((way**2).sum(axis=1).mean()) < 0.01


def test_each_pose_may_have_its_own_covariance():
    rng = np.random.default_rng(3)
    exact = path(20)
    given_poses, registered = noisy(exact, rng, 0.01, 0.01), drifting(exact, rng, 0.002, 0.001)
    each = np.tile(EQUAL, (20, 1, 1))
    np.testing.assert_array_equal(
        hio.smooth_poses(registered, given_poses, each),
        hio.smooth_poses(registered, given_poses, EQUAL),
    )
    each[0] *= 1e-6  # the first pose is exact
    held = hio.smooth_poses(registered, given_poses, each)
    np.testing.assert_allclose(held[0], given_poses[0], atol=1e-4)


def test_no_poses_and_one_pose():
    assert hio.smooth_poses(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), EQUAL).shape == (0, 4, 4)
    assert hio.smooth_poses([], [], EQUAL, []).shape == (0, 4, 4)
    one, other = path(3)[1:2], path(3)[:1]
    np.testing.assert_allclose(hio.smooth_poses(one, other, EQUAL), other, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": np.eye(4)}, r"poses has shape \(4, 4\), expected \(N, 4, 4\)"),
        ({"given_poses": path(2)}, r"given_poses has shape \(2, 4, 4\), expected \(3, 4, 4\)"),
        ({"poses": path(3) * np.nan}, r"poses\[0\]: pose has values that are not finite"),
        ({"given_poses": 2 * path(3)}, r"given_poses\[0\]: pose .*"),
        ({"covariance": np.eye(3)}, r"covariance has shape \(3, 3\), expected \(6, 6\)"),
        ({"covariance": -np.eye(6)}, "covariance is not positive definite"),
        ({"covariance": np.nan * np.eye(6)}, "covariance has values that are not finite"),
        ({"covariance": np.triu(np.ones((6, 6))) + np.eye(6)}, "covariance is not symmetric"),
        ({"covariance": np.stack([EQUAL, -EQUAL, EQUAL])}, r"covariance\[1\] is not positive"),
        ({"motion_deviation": (0.0, 1.0)}, "motion_deviation is 0.0"),
        ({"motion_deviation": 0.1}, r"motion_deviation is 0.1, expected \(m, rad\)"),
        ({"motion_deviation": (0.1,)}, r"motion_deviation is \(0.1,\), expected \(m, rad\)"),
        ({"motion_deviation": (1e-300, 1e-300)}, r"motion_deviation is \(1e-300, 1e-300\)"),
        ({"registered": [[True], []]}, "registered is not an array"),
        ({"registered": [True]}, r"registered is bool \(1,\), expected bool \(3,\)"),
        ({"registered": [1, 0, 1]}, r"registered is int64 \(3,\), expected bool"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    arguments = {"poses": path(3), "given_poses": path(3), "covariance": EQUAL} | changes
    with pytest.raises(ValueError, match=message):
        hio.smooth_poses(**arguments)


def test_a_masked_frame_is_not_registered():
    poses = path(3).astype(float)
    poses[1, :3, 3] += 1
    mask = np.ma.array([True, True, True], mask=[False, True, False])
    masked, plain = (
        hio.smooth_poses(poses, path(3), EQUAL, each) for each in (mask, np.array([1, 0, 1], bool))
    )
    np.testing.assert_array_equal(masked, plain)


def test_traced_arguments_are_refused():
    for name in ("poses", "given_poses", "covariance", "registered"):
        arguments = {"poses": path(3), "given_poses": path(3), "covariance": EQUAL}
        arguments["registered"] = np.ones(3, bool)
        concrete = arguments.pop(name)
        with pytest.raises(ValueError, match=f"{name} is traced"):
            jax.jit(lambda value: hio.smooth_poses(**{name: value}, **arguments))(concrete)  # noqa: B023
