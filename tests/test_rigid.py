"""Which matrices are poses: on the host, and inside jit."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.numerics.rigid import FARTHEST_M, TOLERANCE, is_rigid, is_rigid_on_host

jitted = jax.jit(is_rigid)


def plain(pose):
    """The rule in float64, with its margin: below 0 for a rigid pose."""
    turn, position = pose[:3, :3].astype(float), pose[:3, 3].astype(float)
    with np.errstate(invalid="ignore", over="ignore"):
        margins = [
            np.abs(turn.T @ turn - np.eye(3)).max() / TOLERANCE - 1,
            np.abs(pose[3] - [0, 0, 0, 1]).max() / 1e-6 - 1,
            np.abs(position).max() / FARTHEST_M - 1,
            -np.linalg.det(turn),
        ]
    return np.inf if np.isnan(margins).any() else max(margins)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1e-4, 2e-3, 6e-3, 0.1, 3]), st.booleans())
def test_the_host_accepts_what_jit_accepts(seed, noise, mirrored):
    rng = np.random.default_rng(seed)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix() * (-1 if mirrored else 1)
    pose[:3, :3] += noise * rng.normal(size=(3, 3))
    pose[:3, 3] = 10 ** rng.uniform(-2, 6) * rng.normal(size=3)
    pose[3] += rng.choice([0, 0, 1e-8, 1e-5]) * rng.normal(size=4)
    margin = plain(pose)
    if abs(margin) < 1e-2:  # float32 may round to either side
        return
    assert is_rigid_on_host(pose) == bool(jitted(pose)) == (margin < 0)


@pytest.mark.parametrize("row", range(4))
@pytest.mark.parametrize("column", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_no_pose_has_numbers_that_are_not_finite(row, column, value):
    pose = np.eye(4, dtype=np.float32)
    pose[row, column] = value
    assert not is_rigid_on_host(pose)
    assert not jitted(pose)
