"""Clouds are brought to one shape by equal, reproducible draws."""

import numpy as np
import pytest

from hiosdf_jax._src.mapping import pipeline


def at_height(z):
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = z
    return pose


@pytest.mark.parametrize("capacity", [300, 2700])
def test_rows_are_drawn_from_the_whole_cloud(capacity):
    cloud = np.arange(12000, dtype=np.float32).reshape(4000, 3)
    cloud[::4, 1] = np.nan
    drawn, _ = pipeline.check_and_pad(cloud, at_height(0), capacity)
    assert drawn.shape == (capacity, 3)
    rows = (drawn[:, 0] / 3).astype(int)
    np.testing.assert_array_equal(drawn, cloud[rows])  # no NaN among them
    assert len(np.unique(rows)) == capacity
    other, _ = pipeline.check_and_pad(cloud, at_height(1), capacity)
    assert not np.array_equal(drawn, other)
    at_rest, _ = pipeline.check_and_pad(cloud + np.float32([0, 0, 0.5]), at_height(0), capacity)
    assert not np.array_equal(drawn[:, 0], at_rest[:, 0])
    again, _ = pipeline.check_and_pad(cloud, at_height(0), capacity)
    np.testing.assert_array_equal(drawn, again)


@pytest.mark.parametrize("capacity", [20, 80])
def test_rows_are_drawn_with_equal_chances(capacity):
    cloud = np.arange(300, dtype=np.float32).reshape(100, 3)
    times = np.zeros(100)
    for z in range(4000):
        drawn, _ = pipeline.check_and_pad(cloud, at_height(z), capacity)
        times[(drawn[:, 0] / 3).astype(int)] += 1
    share = times / 4000
    deviation = np.sqrt(capacity / 100 * (1 - capacity / 100) / 4000)
    assert abs(share - capacity / 100).max() < 5 * deviation
