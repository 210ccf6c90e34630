"""Held-out frames: their choice, their returns and their scores."""

import numpy as np
import pytest

import hiosdf_jax as hio
from hiosdf_jax.scoring import draw_returns, held_out_frames, score_held_out

BOUNDS = ((0, 0, 0), (1, 1, 1))


def test_every_tenth_frame_from_the_sixteenth_on():
    assert list(held_out_frames(15)) == []
    assert list(held_out_frames(40)) == [15, 25, 35]


def test_returns_in_range_are_drawn_in_the_world_frame():
    config = hio.Config.light(BOUNDS, min_range=0.5, max_range=2.0)
    lengths = np.concatenate([np.linspace(0.1, 3.0, 100), [np.nan]])
    cloud = lengths[:, None] * np.float32([[0, 0.6, 0.8]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 0, 0]
    drawn = draw_returns(cloud, pose, config, 2, np.random.default_rng(0))
    inside = lengths[(lengths >= 0.5) & (lengths <= 2.0)]
    expected = [5, 0, 0] + inside[:, None] * [-0.6, 0, 0.8]
    np.testing.assert_allclose(np.sort(drawn, axis=0), np.sort(expected, axis=0), atol=1e-6)
    few = draw_returns(cloud, pose, config, 2000, np.random.default_rng(0))
    assert len(few) == 10  # 20,000 over all frames


def test_only_observed_returns_are_scored():
    points = np.zeros((1000, 3), np.float32)
    points[:, 0] = np.linspace(-1, 1, 1000)
    scores = score_held_out(lambda p: 0.1 * p[:, 0], lambda p: p[:, 0] > 0, points)
    assert (scores["points"], scores["points_observed"]) == (1000, 500)
    assert scores["mean_cm"] == pytest.approx(5, rel=1e-2)
    nothing = score_held_out(lambda p: p[:, 0], lambda p: p[:, 0] > 2, points)
    assert nothing == {"points": 1000, "points_observed": 0}
    assert score_held_out(len, len, points[:0]) == {"points": 0, "points_observed": 0}
