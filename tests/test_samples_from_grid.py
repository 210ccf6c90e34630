"""Training samples from the grid."""

import jax
import jax.numpy as jnp
import numpy as np
from voxels import CONFIG, SHAPE, grid_of_room

from hiosdf_jax._src.grid import evidence, geometry, lookup
from hiosdf_jax._src.grid.evidence import is_reached
from hiosdf_jax._src.samples.from_grid import sample_grid
from hiosdf_jax._src.state.pytrees import surface_of


def test_samples_are_near_and_far_and_have_the_grids_distance():
    grid = grid_of_room(range(2))
    sample = jax.jit(sample_grid, static_argnums=0)
    samples = sample(CONFIG, grid, jax.random.key(0))
    assert samples.points_world.shape == (800, 3)
    assert np.asarray(samples.weight).all()
    index, _, inside = geometry.voxel_of(CONFIG, samples.points_world)
    assert np.asarray(inside).all()
    at_center = np.abs(np.asarray(grid.derived.sdf)[tuple(np.asarray(index).T)])
    assert (at_center[:300] < 0.05).all()
    assert (at_center[300:] >= 0.05).all()
    seen = grid.evidence
    known = np.asarray(is_reached(seen.passes, seen.hits) | (seen.behind > 0))
    assert known[tuple(np.asarray(index).T)].all()
    grid_sdf = jax.jit(lookup.grid_sdf, static_argnums=0)
    expected = grid_sdf(CONFIG, surface_of(grid), samples.points_world)
    np.testing.assert_allclose(samples.sdf, expected, atol=1e-6)
    nothing = sample(CONFIG, evidence.empty_grid(CONFIG), jax.random.key(0))
    assert not np.asarray(nothing.weight).any()


def test_few_changes_take_few_samples():
    grid = grid_of_room(range(2))
    sample = jax.jit(sample_grid, static_argnums=0)
    plain = sample(CONFIG, grid, jax.random.key(0))
    change = jnp.zeros(SHAPE, jnp.int8).at[3, 5, 4].set(4)
    changed = grid.replace(evidence=grid.evidence.replace(change=change))
    samples = sample(CONFIG, changed, jax.random.key(0))
    moved = (np.asarray(samples.points_world) != np.asarray(plain.points_world)).any(axis=1)
    assert 0 < moved.sum() <= 10


def test_a_quarter_of_the_far_samples_lies_around_what_has_changed():
    """The other samples are those of a map without changes."""
    grid = grid_of_room(range(2))
    sample = jax.jit(sample_grid, static_argnums=0)
    plain = sample(CONFIG, grid, jax.random.key(0))
    change = np.zeros(SHAPE, np.int8)
    change[3, 4:7, 3:6] = 4  # new
    change[4, 4:7, 3:6] = -70  # vanished
    change[9] = -9  # only looked through
    seen = grid.evidence
    changed = grid.replace(evidence=seen.replace(change=jnp.asarray(change)))
    samples = sample(CONFIG, changed, jax.random.key(0))
    points, others = np.asarray(samples.points_world), np.asarray(plain.points_world)
    np.testing.assert_array_equal(points[:675], others[:675])
    moved = (points[675:] != others[675:]).any(axis=1)
    assert moved.mean() > 0.3  # others would fall in unseen space
    offset = points[675:][moved] - [0.1, 0.55, 0.65]
    assert np.abs(offset.mean(axis=0)).max() < 0.15
    assert 0.3 < np.linalg.norm(offset, axis=1).mean() < 0.6
    index, _, inside = geometry.voxel_of(CONFIG, samples.points_world)
    known = np.asarray(is_reached(seen.passes, seen.hits) | (seen.behind > 0))
    assert np.asarray(inside).all() and known[tuple(np.asarray(index).T)].all()
    grid_sdf = jax.jit(lookup.grid_sdf, static_argnums=0)
    expected = grid_sdf(CONFIG, surface_of(grid), samples.points_world)
    np.testing.assert_allclose(samples.sdf, expected, atol=1e-6)
    np.testing.assert_array_equal(samples.weight, plain.weight)
