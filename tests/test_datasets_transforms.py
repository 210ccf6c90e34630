"""Trees of coordinate frames against products of their poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from poses import random_pose, timed

from hiosdf_jax._src.datasets.timed_poses import pose_at
from hiosdf_jax._src.datasets.transforms import Edge, moves, moving, path_up, transform_up

SEEDS = st.integers(0, 2**31)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_transforms_compose_up_the_tree(seed):
    rng = np.random.default_rng(seed)
    ends = [random_pose(rng), random_pose(rng)]
    base, mount = timed(ends, [4.0, 5.0]), random_pose(rng)
    edges = {
        "lidar": Edge("mast", timed([mount], [0.0]), fixed=True),
        "mast": Edge("base", timed([mount], [99.0]), fixed=True),
        "base": Edge("odom", base, fixed=False),
        "camera": Edge("base", timed([random_pose(rng)], [0.0]), fixed=True),
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


def test_frames_that_form_no_tree():
    fixed = timed([np.eye(4)], [0.0])
    edges = {"a": Edge("b", fixed, fixed=True), "b": Edge("a", fixed, fixed=True)}
    with pytest.raises(ValueError, match="frames form a cycle"):
        path_up(edges, "a")
    with pytest.raises(ValueError, match="frame 'map' is not above 'c'"):
        path_up({"c": Edge("d", fixed, fixed=True)}, "c", "map")


def test_a_pose_that_is_repeated_does_not_move():
    rng = np.random.default_rng(0)
    poses = [random_pose(rng)] * 5
    still = timed(poses, range(5))
    still.quaternions[::2] *= -1  # the same rotations
    assert not moves(still)
    for name in ("positions", "quaternions"):
        moved = timed(poses, range(5))
        getattr(moved, name)[3, 1] += 1e-3
        assert moves(moved)
    for lost in (np.nan, np.inf):
        moved = timed(poses, range(5))
        moved.positions[:] = lost
        assert moves(moved)
    edges = {
        "lidar": Edge("pan", still, fixed=False),
        "pan": Edge("base", moved, fixed=False),
        "base": Edge("map", moved, fixed=True),
    }
    assert moving(edges, path_up(edges, "lidar")) == ["pan"]
