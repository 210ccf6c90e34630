"""Tiles of rows: a function of rows gives the same result in tiles."""

import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.numerics.tiles import map_tiles


@pytest.mark.parametrize("rows", [0, 1, 16, 17, 50])
def test_tiles_do_not_change_the_result(rows):
    points = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    sizes = []

    def function(rows):
        sizes.append(rows.shape[0])
        return rows[..., 0] * 2, rows + 1

    doubled, moved = map_tiles(function, jnp.asarray(points), 16)
    np.testing.assert_array_equal(doubled, points[:, 0] * 2)
    np.testing.assert_array_equal(moved, points + 1)
    assert max(sizes) <= 16


@pytest.mark.parametrize("rows", [0, 1, 16, 17, 50])
def test_tiles_keep_the_axes_of_points(rows):
    assert map_tiles(lambda rows: rows[..., 0], jnp.ones(3), 16).shape == ()
    points = np.random.default_rng(0).normal(size=(rows, 7, 3)).astype(np.float32)
    np.testing.assert_array_equal(map_tiles(lambda rows: rows, jnp.asarray(points), 16), points)
