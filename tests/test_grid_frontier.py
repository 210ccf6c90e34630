"""The distance to unseen space against brute force over all voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import BOUNDS, CONFIG

import hiosdf_jax as hio
from hiosdf_jax._src.grid import frontier, geometry
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.numerics import loops

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


def observed_voxels(state):
    seen = state.grid.evidence
    counts = (array.astype(jnp.float32) for array in (seen.passes, seen.hits, seen.behind))
    return np.asarray(is_observed(state.config, *counts))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.02, 0.98), st.sampled_from([2, 6]))
def test_box_distance_is_exact(seed, share, reach):
    inside = np.random.default_rng(seed).random((7, 5, 6)) < share
    result = np.asarray(signed_box_distance(jnp.asarray(inside), reach))
    expected = brute_force(inside, reach)
    # Beyond the reach along an axis nothing is looked for.
    np.testing.assert_allclose(result, np.clip(expected, -reach, reach), atol=1e-5)


@pytest.mark.parametrize("number", [3, 8])
def test_steps_of_several_shifts_find_the_same(monkeypatch, number):
    """As a GPU takes them, where they do and do not divide all shifts."""
    inside = jnp.asarray(np.random.default_rng(3).random((7, 12, 9)) < 0.9)
    expected = np.asarray(signed_box_distance(inside, 7))
    monkeypatch.setattr(loops, "_MOST_PER_STEP", number)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    search = jax.jit(lambda inside: frontier.signed_box_distance(inside, 7))
    np.testing.assert_array_equal(np.asarray(search(inside)), expected)


def test_without_the_other_kind_the_distance_is_the_reach():
    assert np.all(np.asarray(signed_box_distance(jnp.ones((3, 3, 3), bool), 2)) == 2)
    assert np.all(np.asarray(signed_box_distance(jnp.zeros((3, 3, 3), bool), 2)) == -2)


def test_a_maps_frontier_is_the_distance_to_unseen_voxels_and_to_its_border(room_map):
    seen = observed_voxels(room_map)
    assert 0.2 < seen.mean() < 0.95
    # Space beyond the bounds is unseen: one more layer of voxels says so.
    padded = np.pad(seen, 1)
    expected = 0.1 * brute_force(padded, CONFIG.frontier_voxels)[1:-1, 1:-1, 1:-1]
    step = CONFIG.frontier_horizon / 127
    np.testing.assert_array_equal(
        room_map.grid.derived.frontier_steps, np.clip(np.floor(expected / step + 1e-4), -127, 127)
    )
    index = np.argwhere(np.ones(seen.shape, bool))
    centers = np.asarray(geometry.voxel_center(CONFIG, jnp.asarray(index)))
    answer = hio.query(room_map, centers)
    clipped = np.where(seen, np.maximum(expected, 1e-6), np.minimum(expected, -1e-6)).ravel()
    np.testing.assert_allclose(answer.frontier, clipped, atol=1.01 * step)


def test_the_sign_is_that_of_the_containing_voxel(room_map):
    seen = observed_voxels(room_map)
    # As many points as voxels: one compilation for both tests.
    points = np.random.default_rng(1).uniform(*BOUNDS, (seen.size, 3)).astype(np.float32)
    index, _, _ = geometry.voxel_of(CONFIG, jnp.asarray(points))
    answer = hio.query(room_map, points)
    expected = seen[tuple(np.asarray(index).T)]
    np.testing.assert_array_equal(np.asarray(answer.frontier) > 0, expected)
    # Where rays contradict each other, the sign changes away from surfaces.
    contradicted = expected & ~np.asarray(answer.observed)
    assert not (np.asarray(answer.observed) & ~expected).any()
    assert 0 < contradicted.mean() < 0.01
    assert np.abs(np.asarray(answer.sdf)[contradicted]).max() < 0.02
