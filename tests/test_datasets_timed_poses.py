"""Interpolated poses against matrix logarithms, and files of poses with their errors."""

import re

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from poses import random_pose, timed
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.datasets.timed_poses import pose_at, read_timed_poses
from hiosdf_jax._src.numerics.intake import check_pose

SEEDS = st.integers(0, 2**31)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0, 1))
def test_interpolation_equals_the_matrix_logarithm(seed, share):
    rng = np.random.default_rng(seed)
    first, last = random_pose(rng), random_pose(rng)
    when = 1.7e9 + 0.1 * share  # as large as real stamps
    pose = pose_at(timed([first, last], [1.7e9, 1.7e9 + 0.1]), when, 0.2)
    share = (when - 1.7e9) / 0.1
    # Independently: the matrix logarithm of the rotation between the poses.
    turn = scipy.linalg.logm(first[:3, :3].T @ last[:3, :3]).real
    expected = first[:3, :3] @ scipy.linalg.expm(share * turn)
    np.testing.assert_allclose(pose[:3, :3], expected, atol=2e-5)
    np.testing.assert_allclose(
        pose[:3, 3], first[:3, 3] + share * (last[:3, 3] - first[:3, 3]), atol=2e-5
    )
    check_pose(pose, "between")


def test_poses_are_used_within_their_gaps():
    rng = np.random.default_rng(0)
    poses = [random_pose(rng) for _ in range(4)]
    trajectory = timed(poses, [10.0, 10.1, 11.0, 11.2])
    for pose, stamp in zip(poses, trajectory.stamps, strict=True):
        np.testing.assert_allclose(pose_at(trajectory, stamp, 0.0), pose, atol=1e-12)
    for near, index in [(9.99, 0), (11.21, 3), (10.11, 1), (10.99, 2)]:  # at the ends and in a gap
        np.testing.assert_allclose(pose_at(trajectory, near, 0.2), poses[index], atol=1e-12)
    for far in (9.97, 11.23, 10.13, 10.97, 10.5):
        with pytest.raises(ValueError, match=rf"drive: no pose for {far:.6f} s; the nearest is"):
            pose_at(trajectory, far, 0.2)
    assert np.isfinite(pose_at(trajectory, 10.5, 1.0)).all()


def test_files_of_poses(tmp_path):
    path = tmp_path / "groundtruth.txt"
    half = np.sqrt(0.5)
    path.write_text(f"# time x y z\n\n5.0 1 2 3 0 0 0 1\n5.1 1 2 4 0 0 {half:.4f} {half:.4f}\n")
    pose = pose_at(read_timed_poses(path), 5.05, 0.2)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3.5], atol=1e-9)
    np.testing.assert_allclose(
        pose[:3, :3], Rotation.from_euler("z", 45, degrees=True).as_matrix(), atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no pose, expected at least one"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0", "line 2: 7 columns, expected 8"),
        ("# t\n1 0 0 0 0 0 0 1 9", "line 2: 9 columns, expected 8"),
        ("1 0 0 zero 0 0 0 1", "line 1: could not convert string to float: 'zero'"),
        ("2 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 0 1", "line 3: time 1.000000 s after 2.000000 s"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n1 2 0 0 0 0 0 1", "line 3: another pose at 1.000000"),
        ("nan 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "line 2: time 1.000000 s after nan s"),
    ],
)
def test_malformed_files_name_the_line(tmp_path, text, message):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read_timed_poses(path)
    assert str(error.value).startswith(str(path))


def test_unusable_poses_name_the_line(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n3 0 0 0 0 0 0 0\n4 0 0 0 0 0 .5 .5\n")
    trajectory = read_timed_poses(path)
    np.testing.assert_array_equal(pose_at(trajectory, 1, 2), np.eye(4))
    for stamp, message in [
        (2, "line 2: pose has values that are not finite"),
        (1.5, "line 2: pose has values that are not finite"),
        (3, "line 3: quaternion has length 0, expected 1"),
        (4, "line 4: quaternion has length 0.7071, expected 1"),
    ]:
        with pytest.raises(ValueError, match=re.escape(f"{path}, {message}")):
            pose_at(trajectory, stamp, 2)
