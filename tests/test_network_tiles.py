"""Tiles of samples: together they are all samples, each once."""

import pytest

from hiosdf_jax._src.network import tiles


@pytest.mark.parametrize("rows", [0, 1, 16, 17, 50])
def test_tiles_are_all_rows(monkeypatch, rows):
    monkeypatch.setattr(tiles, "LARGEST", 16)
    dealt = tiles.tile_index(rows, 4)
    assert dealt.shape[1] <= 16 and dealt.size < rows + len(dealt) + 1
    assert sorted(dealt[dealt < rows]) == list(range(rows))
