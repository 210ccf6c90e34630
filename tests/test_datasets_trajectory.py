"""Trajectories in TUM's format, read back by the reader."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiosdf_jax import datasets
from hiosdf_jax._src.datasets.timed_poses import read_timed_poses


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_poses_come_back_to_the_last_digit(tmp_path_factory, seed, count):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * 100
    stamps = 1.7e9 + np.cumsum(rng.uniform(0.01, 1, count))
    file = tmp_path_factory.mktemp("tum") / "poses.txt"
    datasets.write_tum(file, stamps, poses)
    again = read_timed_poses(file)
    np.testing.assert_array_equal(again.stamps, stamps)
    np.testing.assert_array_equal(again.positions, poses[:, :3, 3])
    turned = Rotation.from_quat(again.quaternions).as_matrix()
    np.testing.assert_allclose(turned, poses[:, :3, :3], atol=1e-14)


def test_wrong_trajectories_are_refused(tmp_path):
    file = tmp_path / "poses.txt"
    eye = np.tile(np.eye(4), (2, 1, 1))
    for stamps, poses, message in (
        ([0.0], eye, "expected \\(F,\\) and \\(F, 4, 4\\)"),
        ([1.0, 1.0], eye, "expected seconds that increase"),
        ([0.0, np.nan], eye, "expected seconds that increase"),
        ([0.0, 1.0], 2 * eye, r"poses\[0\] is not rigid"),
    ):
        with pytest.raises(ValueError, match=message):
            datasets.write_tum(file, stamps, poses)
    assert not file.exists()
