"""Voxel indices, the voxels around a point, and windows of the grid."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from voxels import BOUNDS, CONFIG, SHAPE, uniform

from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.numerics.vectors import join, split


def test_voxels_are_aligned_with_the_world_origin():
    points = uniform(0, 500, (-1, -1, -1), (2, 2, 2))
    index, offset, inside = geometry.voxel_of(CONFIG, points)
    cell = np.floor(points.astype(np.float64) / 0.1) - np.floor(np.array(BOUNDS[0]) / 0.1 + 1e-6)
    expected = np.all((cell >= 0) & (cell < SHAPE), axis=1)
    assert CONFIG.grid_shape == SHAPE
    np.testing.assert_array_equal(inside, expected)
    np.testing.assert_array_equal(index[expected], cell[expected])
    center = geometry.voxel_center(CONFIG, index)
    np.testing.assert_allclose(center + offset * 0.1, points, atol=2e-6)


def test_far_and_missing_points_are_outside():
    points = np.array([[np.nan, 0, 0.5], [1e30, 0.5, 0.5], [0, -3e9, 0.5], [0, 0.5, np.inf]])
    index, _, inside = geometry.voxel_of(CONFIG, jnp.asarray(points, jnp.float32))
    assert not np.asarray(inside).any()
    assert (np.asarray(index) >= 0).all()
    assert (np.asarray(index) < SHAPE).all()


def test_voxel_and_offset_do_not_depend_on_the_bounds():
    larger = dataclasses.replace(CONFIG, bounds=((-2.0, -0.5, -1.0), (0.9, 3.0, 1.0)))
    points = uniform(1, 300)
    shift = np.subtract(CONFIG.corner_index, larger.corner_index)
    index, offset, _ = geometry.voxel_of(CONFIG, points)
    index_larger, offset_larger, _ = geometry.voxel_of(larger, points)
    np.testing.assert_array_equal(index + shift, index_larger)
    np.testing.assert_array_equal(offset, offset_larger)


def test_corners_interpolate_affine_functions_exactly_up_to_the_border():
    points = uniform(2, 300)
    corners = geometry.corners_of(CONFIG, split(points))
    centers = geometry.voxel_center(CONFIG, join(corners.index))
    between = np.sum(centers * np.asarray(corners.weight)[..., None], axis=0)
    np.testing.assert_allclose(between, points, atol=1e-6)
    index = np.stack(corners.index, axis=-1)
    inside = np.all((index >= 0) & (index < SHAPE), axis=-1)
    assert 50 < np.sum(~inside.all(axis=0)) < 299
    np.testing.assert_array_equal(corners.inside, inside)
    clipped = np.clip(index, 0, np.array(SHAPE) - 1)
    np.testing.assert_array_equal(
        corners.flat, np.ravel_multi_index(tuple(np.moveaxis(clipped, -1, 0)), SHAPE)
    )


@pytest.mark.parametrize("center", [(0.3, 0.5, 0.6), (-0.29, 0.99, 0.21), (9.0, -9.0, 0.5)])
def test_a_window_holds_all_voxels_within_reach(center):
    reach = 0.25
    shape = geometry.window_shape(CONFIG, reach)
    start = np.array(geometry.window_start(CONFIG, shape, jnp.asarray(center)))
    index = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.all(np.abs(geometry.voxel_center(CONFIG, index) - np.array(center)) <= reach, axis=1)
    assert np.all(index[near] >= start)
    assert np.all(index[near] < start + shape)
    assert np.all(start >= 0)
    assert np.all(start + shape <= SHAPE)
