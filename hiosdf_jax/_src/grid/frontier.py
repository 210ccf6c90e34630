"""The distance from each voxel to unseen space, or from unseen space to what was observed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.grid.windows import RayBox, Window, recompute, whole_grid
from hiosdf_jax._src.numerics.loops import on_all_cores, rounds_per_step
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.shifts import pad_axis
from hiosdf_jax._src.state.pytrees import FRONTIER_STEPS, Grid, frontier_step_m

_INFINITE = 1e12  # squared voxels


def signed_box_distance(inside: jax.Array, reach: int) -> jax.Array:
    """Computes exact distances from voxels' centers to the voxels of the other kind, as boxes.

    A voxel k further along an axis begins k - 1/2 from here. The squared distance to a box is the
    sum of such squares over the axes, so one transform per axis finds the minimum.

    Args:
        inside: (X, Y, Z) bool.
        reach: Largest distance along an axis, voxels.

    Returns:
        (X, Y, Z) float32, voxels; positive where `inside`, negative elsewhere; +-reach where no
        voxel of the other kind is within reach.
    """
    squared = jnp.full(inside.shape, _INFINITE, jnp.float32)
    for axis in range(3):
        squared = _transform_axis(inside, squared, axis, reach)
    distance = jnp.minimum(jnp.sqrt(squared), reach)
    return jnp.where(inside, distance, -distance)


def _transform_axis(inside: jax.Array, squared: jax.Array, axis: int, reach: int) -> jax.Array:
    """Finds the least distance over shifts: to the shifted voxel, or to what it is near."""
    reach = min(reach, inside.shape[axis] - 1)
    # The remaining distance across the axis, for a voxel inside and for one outside.
    to_outside = pad_axis(jnp.where(inside, squared, 0), axis, reach, _INFINITE).computed_once()
    to_inside = pad_axis(jnp.where(inside, 0, squared), axis, reach, _INFINITE).computed_once()

    def compare(k: jax.Array, best: jax.Array) -> jax.Array:
        k = on_all_cores(k, squared.size)
        for step in (-k, k):
            across = jnp.where(inside, to_outside.shifted(step), to_inside.shifted(step))
            best = jnp.minimum(best, across + (k.astype(jnp.float32) - 0.5) ** 2)
        return best

    start = varying_like(squared, inside)
    return jax.lax.fori_loop(
        np.int32(1), np.int32(reach + 1), compare, start, unroll=rounds_per_step(reach)
    )


def update_frontier(config: Config, grid: Grid, box: RayBox) -> Grid:
    """Recomputes the distances to unseen space where a cloud can have changed them.

    Args:
        config: The map's configuration.
        grid: The grid, with new evidence.
        box: The rays of the new evidence.

    Returns:
        The grid with its frontier as if recomputed everywhere. Space beyond the bounds counts as
        unseen.
    """
    horizon_m = config.frontier_voxels * config.voxel_size

    def inside(window: Window) -> jax.Array:
        return _frontier_in(config, grid, window)

    steps = recompute(config, box, horizon_m, inside)
    return grid.replace(derived=grid.derived.replace(frontier_steps=steps))


def recompute_frontier(config: Config, grid: Grid) -> Grid:
    """Recomputes the distances to unseen space of the whole grid."""
    steps = _frontier_in(config, grid, whole_grid(config))
    return grid.replace(derived=grid.derived.replace(frontier_steps=steps))


def _frontier_in(config: Config, grid: Grid, window: Window) -> jax.Array:
    """Recomputes the frontier in a window that holds all that it depends on."""
    start, shape, inner_start, inner = window
    evidence = grid.evidence
    passes, hits, behind = (
        geometry.read_window(array, start, shape).astype(jnp.float32)
        for array in (evidence.passes, evidence.hits, evidence.behind)
    )
    observed = is_observed(config, passes, hits, behind)
    distance = signed_box_distance(observed, config.frontier_voxels)
    for axis in range(3):
        index = start[axis] + jax.lax.broadcasted_iota(jnp.int32, shape, axis)
        border = jnp.minimum(index, config.grid_shape[axis] - 1 - index) + 0.5
        distance = jnp.where(observed, jnp.minimum(distance, border), distance)

    distance_m = geometry.read_window(distance * config.voxel_size, window.within, inner)
    # Rounded down, never farther than it is.
    steps = (
        jnp.floor(distance_m / frontier_step_m(config))
        .clip(-FRONTIER_STEPS, FRONTIER_STEPS)
        .astype(jnp.int8)
    )
    return geometry.write_window(grid.derived.frontier_steps, inner_start, steps)
