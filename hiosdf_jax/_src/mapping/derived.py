"""All that follows from a grid's evidence."""

from __future__ import annotations

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.distance import recompute_distances
from hiosdf_jax._src.grid.frontier import recompute_frontier
from hiosdf_jax._src.state.pytrees import Grid


def recompute_derived(config: Config, grid: Grid) -> Grid:
    """Recomputes the distances, the sides and the frontier of the whole grid."""
    return recompute_frontier(config, recompute_distances(config, grid))
