"""Forgets what a map knows of a box, for changes that the user knows of."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import empty_grid
from hiosdf_jax._src.mapping.derived import recompute_derived
from hiosdf_jax._src.numerics.intake import as_floats, is_traced
from hiosdf_jax._src.numerics.masks import where_leading
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.vectors import each
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import Evidence, Grid, MapState


def forget(state: MapState, box: Any) -> MapState:
    """Makes the inside of a box unobserved, as before its first cloud.

    For a change that is known before a sensor sees it: a door that was opened, a pallet that was
    taken away. Distances, frontier and lower bounds follow at once, the network with the next
    updates. Unobserved is not free: with `unknown="obstacle"`, and in `lower`, the inside is solid
    until a sensor has seen it.

    Args:
        state: The map. Not inside jit.
        box: ((x0, y0, z0), (x1, y1, z1)) m, world frame, concrete numbers. Whole voxels are
            forgotten: those whose centers lie in it. It may reach beyond the bounds.

    Returns:
        The map without this knowledge. It shares memory with the old map.

    Raises:
        ValueError: `state` is not a map, or traced; or `box` is not two finite, ascending corners,
            or is traced.

    Example:
        >>> state = hio.forget(state, ((1.0, 0.0, 0.0), (2.0, 0.2, 2.1)))
    """
    check_map(state)
    corners = as_floats("box", box)
    if is_traced(*jax.tree.leaves(state)):
        raise ValueError("state is traced, expected a map: call forget outside jit")
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or (corners[0] > corners[1]).any():
        raise ValueError(f"box is {box!r}, expected ((x0, y0, z0), (x1, y1, z1)), ascending")
    return state.replace(grid=_forget(state.config, state.grid, corners))


@jax.jit(static_argnums=0)
@plain
def _forget(config: Config, grid: Grid, corners: jax.Array) -> Grid:
    center_world = geometry.window_centers(config, jnp.zeros(3, jnp.int32), config.grid_shape)
    x, y, z = each(lambda c, low, high: (c >= low) & (c <= high), center_world, *corners)
    inside = x & y & z

    def clear(known: jax.Array, empty: jax.Array) -> jax.Array:
        return where_leading(~inside, known, empty)

    evidence: Evidence = jax.tree.map(clear, grid.evidence, empty_grid(config).evidence)
    grid = grid.replace(evidence=evidence)
    return recompute_derived(config, grid)
