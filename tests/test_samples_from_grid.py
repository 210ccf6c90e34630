"""Training samples from the grid."""

import jax
import numpy as np
from voxels import CONFIG, grid_of_room

from hiosdf_jax._src.grid import evidence, geometry, lookup
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.samples.from_grid import sample_grid
from hiosdf_jax._src.state import surface_of


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
    known = np.asarray(is_observed(seen.passes, seen.hits) | (seen.behind > 0))
    assert known[tuple(np.asarray(index).T)].all()
    grid_sdf = jax.jit(lookup.grid_sdf, static_argnums=0)
    expected = grid_sdf(CONFIG, surface_of(grid), samples.points_world)
    np.testing.assert_allclose(samples.sdf, expected, atol=1e-6)
    nothing = sample(CONFIG, evidence.empty_grid(CONFIG), jax.random.key(0))
    assert not np.asarray(nothing.weight).any()
