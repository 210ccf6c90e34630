"""Neighbors of voxels, against a loop over the cells of a mask."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.numerics import shifts

SHAPE = (9, 6, 7)


@pytest.mark.parametrize("reach", [1, 2, 4])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_counts_around_each_voxel(reach, share):
    mask = np.random.default_rng(0).random(SHAPE) < share
    found = jax.jit(shifts.count_around, static_argnums=1)(jnp.asarray(mask), reach)
    cells, every = np.argwhere(mask), np.stack(np.indices(SHAPE), axis=-1)
    far = np.abs(every[..., None, :] - cells).max(axis=-1, initial=0)
    np.testing.assert_array_equal(found, np.sum(far <= reach, axis=-1))


@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_neighbors_are_at_most_one_voxel_away(share):
    mask = np.random.default_rng(1).random(SHAPE) < share
    found = jax.jit(shifts.with_neighbors)(jnp.asarray(mask))
    cells, every = np.argwhere(mask), np.stack(np.indices(SHAPE), axis=-1)
    far = np.abs(every[..., None, :] - cells).max(axis=-1, initial=0)
    np.testing.assert_array_equal(found, np.any(far <= 1, axis=-1))
