"""Poses, trajectories and trees of frames against closed forms and matrix logarithms."""

import re

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.datasets.files import numbered_files, read_rows
from hiosdf_jax._src.datasets.poses import check_pose
from hiosdf_jax._src.datasets.trajectory import Trajectory, pose_at, read_trajectory
from hiosdf_jax._src.datasets.transforms import Edge, path_up, transform_up

SEEDS = st.integers(0, 2**31)


def random_pose(rng, reach=5.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.uniform(-reach, reach, 3)
    return pose


def trajectory_of(poses, stamps, source="drive"):
    poses = np.asarray(poses)
    return Trajectory(
        np.asarray(stamps, float),
        poses[:, :3, 3],
        Rotation.from_matrix(poses[:, :3, :3]).as_quat(),
        source,
    )


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0, 0.002))
def test_rigid_poses_pass(seed, noise):
    """Also those that were written with few digits."""
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
    ],
)
def test_other_poses_are_refused(change, message):
    pose = random_pose(np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"here, line 3: pose .*{message}"):
        check_pose(change(pose), "here, line 3")


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0, 1))
def test_between_two_poses_the_motion_is_even(seed, share):
    rng = np.random.default_rng(seed)
    first, last = random_pose(rng), random_pose(rng)
    when = 1.7e9 + 0.1 * share  # as large as real stamps are
    pose = pose_at(trajectory_of([first, last], [1.7e9, 1.7e9 + 0.1]), when, 0.2)
    share = (when - 1.7e9) / 0.1
    # The independent way: the matrix logarithm of the rotation between them.
    turn = scipy.linalg.logm(first[:3, :3].T @ last[:3, :3]).real
    expected = first[:3, :3] @ scipy.linalg.expm(share * turn)
    np.testing.assert_allclose(pose[:3, :3], expected, atol=2e-5)
    np.testing.assert_allclose(
        pose[:3, 3], first[:3, 3] + share * (last[:3, 3] - first[:3, 3]), atol=2e-5
    )
    check_pose(pose, "between")


def test_which_poses_may_be_used():
    rng = np.random.default_rng(0)
    poses = [random_pose(rng) for _ in range(4)]
    trajectory = trajectory_of(poses, [10.0, 10.1, 11.0, 11.2])
    for pose, stamp in zip(poses, trajectory.stamps, strict=True):
        np.testing.assert_allclose(pose_at(trajectory, stamp, 0.0), pose, atol=1e-12)
    for near, index in [(9.99, 0), (11.21, 3), (10.11, 1), (10.99, 2)]:  # ends and a gap
        np.testing.assert_allclose(pose_at(trajectory, near, 0.2), poses[index], atol=1e-12)
    for far in (9.97, 11.23, 10.13, 10.97, 10.5):
        with pytest.raises(ValueError, match=rf"drive: no pose for {far:.6f} s; the nearest is"):
            pose_at(trajectory, far, 0.2)
    assert np.isfinite(pose_at(trajectory, 10.5, 1.0)).all()


def test_trajectory_files(tmp_path):
    path = tmp_path / "groundtruth.txt"
    half = np.sqrt(0.5)
    path.write_text(f"# time x y z\n\n5.0 1 2 3 0 0 0 1\n5.1 1 2 4 0 0 {half:.4f} {half:.4f}\n")
    pose = pose_at(read_trajectory(path), 5.05, 0.2)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3.5], atol=1e-9)
    np.testing.assert_allclose(
        pose[:3, :3], Rotation.from_euler("z", 45, degrees=True).as_matrix(), atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no pose in it"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0", "line 2: 7 columns, expected 8"),
        ("# t\n1 0 0 0 0 0 0 1 9", "line 2: 9 columns, expected 8"),
        ("1 0 0 zero 0 0 0 1", "line 1: could not convert string to float: 'zero'"),
        ("2 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 0 1", "line 3: time 1.000000 s after 2.000000 s"),
        ("nan 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "line 2: time 1.000000 s after nan s"),
    ],
)
def test_malformed_trajectories_name_the_line(tmp_path, text, message):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read_trajectory(path)
    assert str(error.value).startswith(str(path))


def test_unusable_poses_name_the_line(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n3 0 0 0 0 0 0 0\n4 0 0 0 0 0 .5 .5\n")
    trajectory = read_trajectory(path)
    np.testing.assert_array_equal(pose_at(trajectory, 1, 2), np.eye(4))
    for stamp, message in [
        (2, "line 2: pose has values that are not finite"),
        (1.5, "line 2: pose has values that are not finite"),
        (3, "line 3: quaternion has length 0, expected 1"),
        (4, "line 4: quaternion has length 0.7071, expected 1"),
    ]:
        with pytest.raises(ValueError, match=re.escape(f"{path}, {message}")):
            pose_at(trajectory, stamp, 2)


def test_files(tmp_path):
    for name in ("depth10.png", "depth9.png", "depth9.jpg", "ndepth3.png"):
        (tmp_path / name).touch()
    found = numbered_files(tmp_path, r"depth(\d+)\.png")
    assert [(number, path.name) for number, path in found] == [
        (9, "depth9.png"),
        (10, "depth10.png"),
    ]
    with pytest.raises(ValueError, match=re.escape(f"{tmp_path}: no file is named like")):
        numbered_files(tmp_path, r"(\d+)\.bin")
    (tmp_path / "bytes").write_bytes(b"1 2\n\xff\xfe 3\n")
    with pytest.raises(ValueError, match=r"bytes, line 2: could not convert"):
        read_rows(tmp_path / "bytes", 2)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_transforms_compose_up_the_tree(seed):
    rng = np.random.default_rng(seed)
    ends = [random_pose(rng), random_pose(rng)]
    base, mount = trajectory_of(ends, [4.0, 5.0]), random_pose(rng)
    edges = {
        "lidar": Edge("mast", trajectory_of([mount], [0.0]), fixed=True),
        "mast": Edge("base", trajectory_of([mount], [99.0]), fixed=True),
        "base": Edge("odom", base, fixed=False),
        "camera": Edge("base", trajectory_of([random_pose(rng)], [0.0]), fixed=True),
    }
    assert path_up(edges, "lidar") == ["lidar", "mast", "base", "odom"]
    assert path_up(edges, "lidar", "base") == ["lidar", "mast", "base"]
    assert path_up(edges, "odom") == ["odom"]
    when = rng.uniform(4, 5)
    moved = transform_up(edges, path_up(edges, "lidar"), when)
    np.testing.assert_allclose(moved, pose_at(base, when, 1.0) @ mount @ mount, atol=1e-9)
    still = transform_up(edges, path_up(edges, "lidar", "base"), 7.0)
    np.testing.assert_allclose(still, mount @ mount, atol=1e-9)
    with pytest.raises(ValueError, match="drive: no pose for 7"):
        transform_up(edges, path_up(edges, "lidar"), 7.0)


def test_trees_that_are_none():
    fixed = trajectory_of([np.eye(4)], [0.0])
    edges = {"a": Edge("b", fixed, fixed=True), "b": Edge("a", fixed, fixed=True)}
    with pytest.raises(ValueError, match="frames go round in a circle"):
        path_up(edges, "a")
    with pytest.raises(ValueError, match="frame 'map' is not above 'c'"):
        path_up({"c": Edge("d", fixed, fixed=True)}, "c", "map")
