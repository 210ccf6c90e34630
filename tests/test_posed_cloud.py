"""Checks of clouds and poses, and their messages."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from poses import random_pose

from hiosdf_jax._src.numerics.posed_cloud import check_pose, check_shapes, finite_rows

SEEDS = st.integers(0, 2**31)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0, 0.002))
def test_rigid_poses_pass(seed, noise):
    """Including poses written with few digits."""
    rng = np.random.default_rng(seed)
    pose = random_pose(rng, 100)
    pose[:3, :3] += rng.uniform(-noise, noise, (3, 3)) / 2
    checked = check_pose(pose, "here")
    assert checked.dtype == np.float32
    np.testing.assert_allclose(checked, pose, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pose: pose * np.nan, "not finite"),
        (lambda pose: np.full((4, 4), -np.inf), "not finite"),
        (lambda pose: pose * [1.01, 1.01, 1.01, 1], "not rigid"),
        (lambda pose: pose * [-1, 1, 1, 1], "not rigid"),  # a mirror
        (lambda pose: np.zeros((4, 4)), "not rigid"),
        (lambda pose: pose.T, "not rigid"),
        (lambda pose: pose[:3], r"shape \(3, 4\), expected \(4, 4\)"),
        (lambda pose: pose + 1e300 * np.eye(4, k=3), "not finite"),  # not in float32
    ],
)
def test_other_poses_are_refused(change, message):
    pose = random_pose(np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"here, line 3: pose .*{message}"):
        check_pose(change(pose), "here, line 3")


def test_the_source_of_a_pose_is_optional():
    with pytest.raises(ValueError, match=r"^pose is not rigid, expected a rotation and a trans"):
        check_pose(np.zeros((4, 4)))


def test_rows_with_nan_or_inf_are_no_returns():
    cloud = np.arange(12.0).reshape(4, 3)
    cloud[1, 2], cloud[2, 0] = np.nan, -np.inf
    assert finite_rows(cloud).tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.full((5, 3), np.nan), "cloud has no finite row among its 5, expected at least one"),
        (np.zeros((0, 3)), "cloud has no finite row among its 0"),
        (np.zeros((5, 4)), r"cloud has shape \(5, 4\), expected \(N, 3\)"),
        (np.zeros(3), r"cloud has shape \(3,\), expected \(N, 3\)"),
    ],
)
def test_clouds_without_returns_are_refused(cloud, message):
    with pytest.raises(ValueError, match=message):
        finite_rows(cloud)


def test_shapes_are_checked_without_values():
    check_shapes(np.full((2, 3), np.nan), np.zeros((4, 4)))
    with pytest.raises(ValueError, match=r"cloud has shape \(2, 4\), expected \(N, 3\)"):
        check_shapes(np.zeros((2, 4)), np.eye(4))
    with pytest.raises(ValueError, match=r"pose has shape \(3, 3\), expected \(4, 4\)"):
        check_shapes(np.zeros((2, 3)), np.eye(3))
