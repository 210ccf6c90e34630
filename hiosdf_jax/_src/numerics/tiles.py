"""Tiles of rows, so that what is computed for them stays in a CPU's cache.

A GPU is faster with all rows at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.export
import jax.numpy as jnp


def tile_count(rows: int, largest: int) -> int:
    """Returns the number of tiles for a number of rows on the default device.

    Args:
        rows: Number of rows. A number that `jax.export` leaves open makes one tile.
        largest: Rows of a tile, at most.

    Returns:
        The number of tiles; 1 on a GPU.
    """
    if jax.export.is_symbolic_dim(rows):
        return 1
    return -(-rows // largest) if jax.default_backend() == "cpu" else 1


def map_tiles(function: Callable[[jax.Array], Any], points: jax.Array, largest: int) -> Any:
    """Applies a function of rows to (..., 3) points, tile by tile.

    Args:
        function: Maps (K, 3) to arrays with K rows.
        points: (..., 3).
        largest: Rows of a tile, at most.

    Returns:
        The function's result for all points at once, with axes (...) instead of rows.
    """
    count = points.size // 3
    tiles = tile_count(count, largest)
    if tiles <= 1:
        return function(points)
    size = -(-count // tiles)
    padded = jnp.pad(points.reshape(-1, 3), ((0, size * tiles - count), (0, 0)))
    result = jax.lax.map(function, padded.reshape(tiles, size, 3))

    def join(array: jax.Array) -> jax.Array:
        rest = array.shape[2:]
        return array.reshape(-1, *rest)[:count].reshape(*points.shape[:-1], *rest)

    return jax.tree.map(join, result)
