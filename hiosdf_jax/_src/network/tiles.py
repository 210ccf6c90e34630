"""Tiles of samples for training.

They bound the memory of the activations. On two cores with jax 0.12, a training step of
`Config.light` takes 0.78 of its time with tiles of 4,096 instead of 1,024 rows, and one of the
paper's network 1.03. With jax 0.11 both sizes are equally fast. Queries take the same time with 512
to 16,384. A GPU is faster with all rows at once.
"""

from __future__ import annotations

import jax
import numpy as np

from hiosdf_jax._src.numerics.tiles import tile_count

LARGEST = 4096  # rows

# On a GPU, XLA sums the gradient of a weight in 32 parts of a tile, in units of eight rows. Where
# the rows do not divide, it pads copies of all activations: a tenth of a training step.
_UNIT = 32 * 8
_MOST_PADDING = 1.03  # more rows than that cost more than the copies


def tile_index(rows: int, groups: int) -> np.ndarray:
    """Distributes rows over tiles in turn.

    Args:
        rows: Number of rows.
        groups: Each tile is divided into this many groups of equal size.

    Returns:
        Row numbers, (tiles, K) int; numbers from `rows` on are padding.
    """
    tiles = max(tile_count(rows, LARGEST), 1)
    size = -(-rows // tiles)
    if jax.default_backend() != "cpu":
        padded = -(-size // (groups * _UNIT)) * groups * _UNIT
        size = padded if padded <= _MOST_PADDING * size else size
    return np.arange(size * tiles).reshape(-1, tiles).T
