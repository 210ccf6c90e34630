"""The distance to unseen space: from each voxel to the nearest one on the other side."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, lookup
from hiosdf_jax._src.grid.change import Change, Window, recompute
from hiosdf_jax._src.state import Grid

_INFINITE = 1e12  # squared voxels


def signed_box_distance(inside: jax.Array, reach: int) -> jax.Array:
    """Exact distances from voxels' centres to the voxels of the other kind, as boxes.

    A voxel k further along an axis begins k - 1/2 from here, and the square of the distance to a
    box is the sum of such squares over the axes: three separable passes find its minimum.

    Args:
        inside: (X, Y, Z) bool.
        reach: Voxels of the other kind farther than this along an axis are not looked for, voxels.

    Returns:
        (X, Y, Z) float32, voxels; positive where `inside`, negative elsewhere; +-reach where
        there is no voxel of the other kind within it.
    """
    squared = jnp.full(inside.shape, _INFINITE, jnp.float32)
    for axis in range(3):
        squared = _pass(inside, squared, axis, reach)
    distance = jnp.minimum(jnp.sqrt(squared), reach)
    return jnp.where(inside, distance, -distance)


def _pass(inside: jax.Array, squared: jax.Array, axis: int, reach: int) -> jax.Array:
    """Least distance over shifts along an axis: to the shifted voxel, or to what it is near."""
    length = inside.shape[axis]
    reach = min(reach, length - 1)
    margin = [(0, 0)] * 3
    margin[axis] = (reach, reach)
    # What is left to go across the axis, for a voxel inside and for one that is not.
    to_outside = jnp.pad(jnp.where(inside, squared, 0), margin, constant_values=_INFINITE)
    to_inside = jnp.pad(jnp.where(inside, 0, squared), margin, constant_values=_INFINITE)
    best = squared
    for k in range(1, reach + 1):
        for start in (reach - k, reach + k):
            across = jnp.where(
                inside,
                jax.lax.slice_in_dim(to_outside, start, start + length, axis=axis),
                jax.lax.slice_in_dim(to_inside, start, start + length, axis=axis),
            )
            best = jnp.minimum(best, across + (k - 0.5) ** 2)
    return best


def update_frontier(config: Config, grid: Grid, change: Change) -> Grid:
    """Recomputes the distances to unseen space where something new can have been seen.

    Args:
        config: The map's configuration.
        grid: The grid, with new evidence.
        change: Where that is.

    Returns:
        The grid with its frontier as if recomputed everywhere. What lies beyond the bounds has
        not been seen.
    """
    horizon_m = config.frontier_voxels * config.voxel_size

    def inside(window: Window) -> jax.Array:
        return _frontier_in(config, grid, window)

    frontier = recompute(config, change, horizon_m, inside)
    return grid.replace(surface=grid.surface.replace(frontier=frontier))


def _frontier_in(config: Config, grid: Grid, window: Window) -> jax.Array:
    """The grid's frontier, new in a window that holds all it can depend on."""
    start, shape, inner_start, inner = window
    seen = lookup.observed(
        geometry.read_window(grid.passes, start, shape),
        geometry.read_window(grid.hits, start, shape),
    )
    distance = signed_box_distance(seen, config.frontier_voxels)
    for axis in range(3):
        index = start[axis] + jax.lax.broadcasted_iota(jnp.int32, shape, axis)
        border = jnp.minimum(index, config.grid_shape[axis] - 1 - index) + 0.5
        distance = jnp.where(seen, jnp.minimum(distance, border), distance)

    metres = geometry.read_window(distance * config.voxel_size, window.within, inner)
    # Rounded down: never farther than it is.
    steps = (
        jnp.floor(metres / geometry.frontier_step_m(config))
        .clip(-geometry.FRONTIER_STEPS, geometry.FRONTIER_STEPS)
        .astype(jnp.int8)
    )
    return geometry.write_window(grid.surface.frontier, inner_start, steps)
