"""Tiles of rows: together they are all rows, each once."""

import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.network import tiles


@pytest.mark.parametrize("rows", [0, 1, 16, 17, 50])
def test_tiles_are_all_rows(monkeypatch, rows):
    monkeypatch.setattr(tiles, "_ROWS", 16)
    dealt = tiles.tile_index(rows, 4)
    assert dealt.shape[1] <= 16 and dealt.size < rows + len(dealt) + 1
    assert sorted(dealt[dealt < rows]) == list(range(rows))
    points = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    sizes = []

    def function(rows):
        sizes.append(rows.shape[0])
        return rows[..., 0] * 2, rows + 1

    doubled, moved = tiles.map_tiles(function, jnp.asarray(points))
    np.testing.assert_array_equal(doubled, points[:, 0] * 2)
    np.testing.assert_array_equal(moved, points + 1)
    assert max(sizes) <= 16
    single = tiles.map_tiles(lambda rows: rows[..., 0], jnp.ones(3))
    assert single.shape == ()
    stacked = tiles.map_tiles(lambda rows: rows, jnp.asarray(points[:, None] + np.zeros((1, 7, 1))))
    np.testing.assert_allclose(stacked, np.broadcast_to(points[:, None], (rows, 7, 3)))
