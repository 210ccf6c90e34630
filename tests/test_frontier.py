"""The distance to unseen space against brute force over all voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import BOUNDS, CONFIG, map_of_room

import hiosdf_jax as hio
from hiosdf_jax._src.grid import frontier, geometry, lookup

signed_box_distance = jax.jit(frontier.signed_box_distance, static_argnums=1)


def brute_force(inside, reach):
    """float64, from the definition: every voxel against every box of the other kind."""
    cells = np.argwhere(np.ones(inside.shape, bool))
    flat = inside.ravel()
    result = np.full(inside.size, float(reach))
    for k, cell in enumerate(cells):
        others = cells[flat != flat[k]]
        if len(others):
            gaps = np.maximum(np.abs(others - cell) - 0.5, 0)
            result[k] = min(reach, np.sqrt((gaps**2).sum(axis=1)).min())
    return np.where(inside, result.reshape(inside.shape), -result.reshape(inside.shape))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.02, 0.98), st.sampled_from([2, 6]))
def test_box_distance_is_exact(seed, share, reach):
    inside = np.random.default_rng(seed).random((7, 5, 6)) < share
    result = np.asarray(signed_box_distance(jnp.asarray(inside), reach))
    expected = brute_force(inside, reach)
    # Beyond the reach along an axis nothing is looked for.
    np.testing.assert_allclose(result, np.clip(expected, -reach, reach), atol=1e-5)


def test_without_the_other_kind_the_distance_is_the_reach():
    assert np.all(np.asarray(signed_box_distance(jnp.ones((3, 3, 3), bool), 2)) == 2)
    assert np.all(np.asarray(signed_box_distance(jnp.zeros((3, 3, 3), bool), 2)) == -2)


@pytest.fixture(scope="module")
def state():
    return map_of_room(CONFIG, jax.random.key(0), frames=2)


def test_a_maps_frontier_is_the_distance_to_unseen_voxels_and_to_its_border(state):
    seen = np.asarray(is_observed(state.grid.evidence.passes, state.grid.evidence.hits))
    assert 0.2 < seen.mean() < 0.95
    # What lies beyond the bounds has not been seen: one more layer of voxels says that.
    padded = np.pad(seen, 1)
    expected = 0.1 * brute_force(padded, CONFIG.frontier_voxels)[1:-1, 1:-1, 1:-1]
    step = CONFIG.frontier_horizon / 127
    np.testing.assert_array_equal(
        state.grid.derived.frontier, np.clip(np.floor(expected / step + 1e-4), -127, 127)
    )
    index = np.argwhere(np.ones(seen.shape, bool))
    centers = np.asarray(geometry.voxel_center(CONFIG, jnp.asarray(index)))
    answer = hio.query(state, centers)
    clipped = np.where(seen, np.maximum(expected, 1e-6), np.minimum(expected, -1e-6)).ravel()
    np.testing.assert_allclose(answer.frontier, clipped, atol=1.01 * step)


def test_the_sign_is_that_of_the_containing_voxel(state):
    seen = np.asarray(is_observed(state.grid.evidence.passes, state.grid.evidence.hits))
    points = np.random.default_rng(1).uniform(*BOUNDS, (4000, 3)).astype(np.float32)
    index, _, _ = geometry.voxel_of(CONFIG, jnp.asarray(points))
    answer = hio.query(state, points)
    expected = seen[tuple(np.asarray(index).T)]
    np.testing.assert_array_equal(answer.observed, expected)
    np.testing.assert_array_equal(np.asarray(answer.frontier) > 0, expected)


def test_points_outside_have_not_been_seen(state):
    outside = np.array([[1.3, 0, 0], [0, 0, -5.0], [3e38, 0, 0]], np.float32)
    answer = hio.query(state, outside)
    assert not np.asarray(answer.observed).any()
    assert np.all(np.asarray(answer.frontier)[:2] <= [-0.1, -4.2])
    assert np.isfinite(np.asarray(answer.frontier)).all()


def test_unseen_space_is_an_obstacle_on_request(state):
    points = np.random.default_rng(2).uniform(-1.4, 1.4, (3000, 3)).astype(np.float32)
    plain, solid = hio.query(state, points), hio.query(state, points, unknown="obstacle")
    expected = np.minimum(plain.sdf, plain.frontier)
    np.testing.assert_allclose(solid.sdf, expected, atol=1e-6)
    assert (np.asarray(solid.sdf)[~np.asarray(solid.observed)] <= 0).all()
    assert 0.2 < np.mean(np.asarray(plain.sdf) > plain.frontier) < 0.98
    np.testing.assert_array_equal(solid.frontier, plain.frontier)
    np.testing.assert_array_equal(solid.lower, plain.lower)
    np.testing.assert_allclose(hio.sdf(state, points, unknown="obstacle"), solid.sdf, atol=1e-6)
    # Its gradient is its own: where the frontier is the nearer, that of the frontier.
    step = 1e-3
    unseen_nearer = np.asarray(plain.frontier) < np.asarray(plain.sdf) - 0.05
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        high = hio.sdf(state, points + shift, unknown="obstacle")
        low = hio.sdf(state, points - shift, unknown="obstacle")
        slope = np.asarray(high - low) / (2 * step)
        agrees = np.abs(slope - np.asarray(solid.grad)[:, axis]) < 0.02
        assert agrees[unseen_nearer].mean() > 0.95  # not at faces of cells


def test_policies_have_names(state):
    for function in (hio.sdf, hio.sdf_and_grad, hio.query):
        with pytest.raises(ValueError, match="unknown is 'free', expected 'network' or 'obstacle'"):
            function(state, np.zeros(3), unknown="free")
