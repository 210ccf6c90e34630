"""Clouds of depth and range images against the projection that they invert."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiosdf_jax._src.datasets.sensors import depth_to_cloud, ranges_to_cloud

K = np.array([[160.0, 0.0, 3.5], [0.0, 150.0, 2.5], [0.0, 0.0, 1.0]])


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**31),
    st.floats(20, 900),
    st.floats(20, 900),
    st.floats(-10, 10),
)
def test_points_project_back_to_their_pixels(seed, fx, fy, skew):
    depth = np.random.default_rng(seed).uniform(0.1, 30, (4, 7)).astype(np.float32)
    intrinsics = np.array([[fx, skew, 2.7], [0, fy, 1.9], [0, 0, 1]])
    cloud = np.asarray(depth_to_cloud(depth, intrinsics), float)
    np.testing.assert_allclose(cloud[:, 2], depth.ravel(), rtol=1e-6)  # along the axis
    pixel = cloud @ intrinsics.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    v, u = np.indices(depth.shape).reshape(2, -1)
    np.testing.assert_allclose(pixel, np.stack([u, v], axis=-1), atol=2e-4)


def test_axes_are_right_down_forward():
    depth = jnp.full((6, 8), 2.0)
    top_left, bottom_right = depth_to_cloud(depth, K)[jnp.array([0, -1])]
    np.testing.assert_allclose(top_left, [-3.5 / 160 * 2, -2.5 / 150 * 2, 2], rtol=1e-6)
    np.testing.assert_allclose(bottom_right, [3.5 / 160 * 2, 2.5 / 150 * 2, 2], rtol=1e-6)


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan, np.inf, -np.inf])
def test_no_return_is_a_row_of_nan(nothing):
    depth = np.full((3, 4), 1.5, np.float32)
    depth[1, 2] = nothing
    cloud = np.asarray(depth_to_cloud(depth, K))
    assert np.isnan(cloud[6]).all()
    assert np.isfinite(np.delete(cloud, 6, axis=0)).all()
    directions = np.broadcast_to([0.0, 0.6, 0.8], (3, 4, 3))
    cloud = np.asarray(ranges_to_cloud(depth, directions))
    assert np.isnan(cloud[6]).all()
    np.testing.assert_allclose(np.delete(cloud, 6, axis=0), [[0, 0.9, 1.2]] * 11, rtol=1e-6)


def test_batches_and_jit_give_the_same_clouds():
    depth = np.random.default_rng(0).uniform(0.1, 5, (2, 3, 4, 5)).astype(np.float32)
    batched = depth_to_cloud(depth, K)
    assert batched.shape == (2, 3, 20, 3)
    one_by_one = [[depth_to_cloud(image, K) for image in row] for row in depth]
    np.testing.assert_array_equal(batched, np.array(one_by_one))
    np.testing.assert_allclose(jax.jit(depth_to_cloud)(depth, K), batched, rtol=1e-6)
    directions = np.random.default_rng(1).normal(size=(4, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(
        jax.jit(ranges_to_cloud)(depth[0, 0], directions),
        (depth[0, 0][..., None] * directions).reshape(-1, 3),
        rtol=1e-6,
    )


def test_integers_are_meters_too():
    cloud = depth_to_cloud(np.full((2, 2), 3, np.uint16), K)
    np.testing.assert_allclose(cloud[:, 2], 3.0)
    assert jnp.issubdtype(cloud.dtype, jnp.floating)


def test_messages_name_the_wrong_shape():
    with pytest.raises(ValueError, match=r"depth has shape \(5,\), expected \(\.\.\., H, W\)"):
        depth_to_cloud(np.ones(5), K)
    with pytest.raises(ValueError, match=r"intrinsics has shape \(4,\), expected \(3, 3\)"):
        depth_to_cloud(np.ones((2, 2)), np.ones(4))
    with pytest.raises(ValueError, match=r"directions has shape \(4, 3\), expected \(2, 2, 3\)"):
        ranges_to_cloud(np.ones((2, 2)), np.ones((4, 3)))


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (K.T, r"0, 0, 1 in the last row; is it transposed\?"),
        (K * 2, r"0, 0, 1 in the last row; is it scaled\?"),
        (K * [[1, 1, 1], [1, 1, 1], [1, 1, 0]], r"0, 0, 1 in the last row; is it scaled\?"),
        (K + 3 * np.eye(3, k=-1) * [[0], [1], [0]], "0 left of the second focal length"),
        (K * [[-1], [1], [1]], "focal lengths > 0"),
        (K * [[1], [1e-42], [1]], "focal lengths > 0"),  # not at the full precision of float32
        (np.where(K == 3.5, np.inf, K), "finite numbers"),
        (K * [[np.nan], [1], [1]], "finite numbers"),
    ],
)
def test_matrices_that_are_no_pinhole(matrix, reason):
    for intrinsics in (matrix, jnp.array(matrix.tolist())):
        with pytest.raises(ValueError, match=rf"^intrinsics is \[\[.*\], expected {reason}$"):
            depth_to_cloud(np.ones((2, 2)), intrinsics)


def test_a_matrix_too_large_for_float32():
    with pytest.raises(ValueError, match="expected finite numbers"):
        depth_to_cloud(np.ones((2, 2)), K * [[1e40], [1], [1]])


def test_matrices_with_few_digits():
    cloud = depth_to_cloud(np.ones((2, 2)), K + 1e-7)
    np.testing.assert_allclose(cloud, depth_to_cloud(np.ones((2, 2)), K), atol=1e-6)
