"""Checks of clouds and poses, and their messages."""

import warnings

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from poses import random_pose
from room import CONFIG

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.pipeline import check_and_pad, warn_out_of_range, warn_outside
from hiosdf_jax._src.numerics.intake import as_traced, check_pose, cloud_and_returns

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


def sheared():
    return np.eye(4) + 0.05 * np.eye(4, k=1) * [1, 1, 0, 0]


def moved(pose, offset):
    return pose + np.pad(np.reshape(offset, (3, 1)), ((0, 1), (3, 0)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pose: pose * np.nan, "not finite"),
        (lambda pose: np.full((4, 4), -np.inf), "not finite"),
        (lambda pose: pose * [1.01, 1.01, 1.01, 1], "not rigid: its columns have length 1.01, "),
        (lambda pose: pose * [1, 1.1, 1, 1], r"not rigid: .* length \[1. , 1.1, 1. \], expected 1"),
        (lambda pose: pose * [-1, 1, 1, 1], "not rigid: its determinant is -1, expected 1"),
        (lambda pose: pose @ sheared(), "not rigid: its columns are not perpendicular"),
        (lambda pose: np.zeros((4, 4)), r"not rigid: its last row is \[0., 0., 0., 0.\], expected"),
        (lambda pose: np.diag([0.0, 0, 0, 1]), "not rigid: its columns have length 0, expected 1"),
        (lambda pose: pose.T, r"not rigid: its last row is .*\[0, 0, 0, 1\]; is it transposed\?"),
        (lambda pose: moved(pose, [1e5, 1e5, 1e5]), "173.2 km from the origin, .* at most 100 km"),
        (lambda pose: pose[:3], r"shape \(3, 4\), expected \(4, 4\)"),
        (lambda pose: pose + 1e300 * np.eye(4, k=3), "not finite"),  # not in float32
    ],
)
def test_other_poses_are_refused(change, message):
    pose = random_pose(np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"here, line 3: pose .*{message}") as error:
        check_pose(change(pose), "here, line 3")
    assert ("transposed" in str(error.value)) == ("transposed" in message)


def test_the_source_of_a_pose_is_optional():
    with pytest.raises(ValueError, match=r"^pose is not rigid: its last row is"):
        check_pose(np.zeros((4, 4)))


def test_rows_with_nan_or_inf_are_no_returns():
    cloud = np.arange(12.0).reshape(4, 3)
    cloud[1, 2], cloud[2, 0] = np.nan, -np.inf
    _, finite = cloud_and_returns(cloud)
    assert finite.tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.full((5, 3), np.nan), "cloud has no finite row among its 5, expected at least one"),
        (np.zeros((0, 3)), "cloud has no finite row among its 0"),
        (np.zeros((5, 4)), r"cloud has shape \(5, 4\), expected \(N, 3\)$"),
        (np.zeros((3, 4)), r"cloud has shape \(3, 4\), expected \(N, 3\); is it transposed\?"),
        (np.zeros(3), r"cloud has shape \(3,\), expected \(N, 3\)"),
    ],
)
def test_clouds_without_returns_are_refused(cloud, message):
    with pytest.raises(ValueError, match=message):
        cloud_and_returns(cloud)


def test_shapes_are_checked_without_values():
    as_traced(np.full((2, 3), np.nan), np.zeros((4, 4)))
    with pytest.raises(ValueError, match=r"cloud has shape \(2, 4\), expected \(N, 3\)"):
        as_traced(np.zeros((2, 4)), np.eye(4))
    with pytest.raises(ValueError, match=r"pose has shape \(3, 3\), expected \(4, 4\)"):
        as_traced(np.zeros((2, 3)), np.eye(3))


@pytest.mark.parametrize(
    ("scale", "max_range", "hint"),
    [
        (1000, 5.0, "looks like millimeters, expected m"),
        (100, 5.0, "looks like centimeters, expected m"),
        (300, 20.0, "looks like centimeters or millimeters, expected m"),
        (1e6, 5.0, "Its unit must be m; Config.min_in_range is 0.01"),
    ],
)
def test_the_likely_unit_is_named(scale, max_range, hint):
    cloud = np.float32(scale) * on_a_sphere(3.0)
    with pytest.warns(UserWarning, match=f"has 0 of 500 returns between .* {hint}"):
        assert warn_out_of_range(cloud, 0.5, max_range, 0.01)


def on_a_sphere(radius):
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (radius * directions).astype(np.float32)


def padded(cloud):
    """With many rows that are not returns, and some beyond all ranges."""
    rows = np.full((20_000, 3), np.nan, np.float32)
    rows[: len(cloud)] = cloud
    rows[-3:] = [[np.inf, 0, 0], [3e38, 3e38, 3e38], [-np.inf, np.inf, 1]]
    return rows


@pytest.mark.parametrize("prepared", [np.asarray, padded])
@pytest.mark.parametrize(("inside", "warns"), [(0, True), (4, True), (5, False), (500, False)])
def test_returns_outside_the_bounds_are_warned_of(prepared, inside, warns):
    """Each direction is turned; the bounds hold a sphere of 3 m around the sensor, not of 4 m."""
    cloud = on_a_sphere(7.0)
    cloud[500 - inside :] *= 3 / 7
    pose = moved(np.diag([1.0, -1, -1, 1]), [10.0, 0, 0]).astype(np.float32)
    bounds = ((6.9, -3.1, -3.1), (13.1, 3.1, 3.1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_outside(prepared(cloud), pose, bounds, 0.1, 8.0, 0.01)
        warn_outside(prepared(cloud), pose, bounds, 0.1, 8.0, 0.0)  # switched off
        warn_outside(prepared(cloud), pose, bounds, 0.1, 1.0, 0.01)  # none is in range
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == warns
    assert all("less than 1 % of its returns in range inside the bounds" in m for m in messages)


def spread_out(usable, rows, capacity, first):
    """A cloud of one usable row at `first`, others spread evenly, and far ones; then padding."""
    cloud = np.full((capacity, 3), np.nan, np.float32)
    cloud[:rows] = [9.0, 0, 0]
    cloud[np.linspace(first, rows - 1, usable).astype(int)] = [2.0, 0, 0]
    return cloud


@pytest.mark.parametrize("first", [0, 7])
@pytest.mark.parametrize("capacity", [20_000, 50_000, 100_000])
@pytest.mark.parametrize("share", [0.1, 1.0])
def test_a_first_look_at_few_rows_does_not_hide_too_few_usable_ones(capacity, share, first):
    """Whatever the rows that are looked at first: `share` of the rows are returns."""
    rows = int(share * capacity)
    bounds = ((-3, -3, -3), (3, 3, 3))
    for usable, warns in ((1, True), (rows // 500, True), (rows // 40, False)):
        cloud = spread_out(usable, rows, capacity, first)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert warn_out_of_range(cloud, 0.1, 5.0, 0.01) == warns
            warn_outside(cloud, np.eye(4, dtype=np.float32), bounds, 0.1, 20.0, 0.01)
        assert len(caught) == 2 * warns


@pytest.mark.parametrize("width", [100, 200, 320, 640])
def test_one_column_of_an_image_in_range_is_too_few(width):
    image = np.full((50_000 // width, width, 3), [9.0, 0, 0], np.float32)
    image[:, 0] = [2.0, 0, 0]
    with pytest.warns(UserWarning, match="returns between min_range"):
        assert warn_out_of_range(image.reshape(-1, 3), 0.1, 5.0, 0.02)


@pytest.mark.parametrize("rows", [1, 250, 300, 301, 4000])
def test_a_padded_cloud_is_what_update_maps(rows):
    cloud, pose = np.random.default_rng(rows).normal(size=(rows, 3)), np.eye(4)
    cloud[0, 1] = np.nan if rows > 1 else 1.0
    padded = hio.pad_cloud(CONFIG, cloud, pose)
    assert padded.shape == (CONFIG.max_points, 3) and padded.dtype == np.float32
    np.testing.assert_array_equal(padded, check_and_pad(cloud, pose, CONFIG.max_points)[0])
    np.testing.assert_array_equal(padded, hio.pad_cloud(CONFIG, padded))  # no second draw


def test_pad_cloud_refuses_what_update_refuses():
    with pytest.raises(ValueError, match="no finite row"):
        hio.pad_cloud(CONFIG, np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match=r"cloud has shape \(3, 2\)"):
        hio.pad_cloud(CONFIG, np.ones((3, 2)))
    with pytest.raises(ValueError, match="config is int"):
        hio.pad_cloud(3, np.ones((3, 3)))
    with pytest.raises(ValueError, match="cloud is traced"):
        jax.jit(lambda cloud: hio.pad_cloud(CONFIG, cloud))(np.ones((3, 3)))
