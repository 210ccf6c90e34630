"""The evidence of rays: stored in float16, updated in float32 in a window around the sensor."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.rays import HIDDEN_VOXELS, Rays
from hiosdf_jax._src.state.pytrees import FRONTIER_STEPS, NO_FEATURE, Derived, Evidence, Grid, Side

# Half the memory of float32, and finer than the noise.
_STORED = jnp.float16

# Rounding to float16 multiplies a number by at most 1 + 2^-11 = 1.0005.
_ROUNDING = 1.0007

# A voxel is free with at least this many passes per ray that ended just before it: noise puts some
# ends of rays too far away.
FREE_RATIO = 0.1

# It holds an observed surface with this many hits per such ray, beside `min_hits` - 1. Fewer are
# noise behind a surface or returns past an edge. With 0.1, twice as many sign changes lie far from
# any surface.
_SURFACE_RATIO = 0.5


class EvidenceWindow(NamedTuple):
    """The evidence that one cloud can change.

    Attributes:
        start: First voxel of the window in the grid, (3,) int32.
        hits: As in `Evidence`, (A, B, C) float32: one cloud may add more than float16 holds.
        passes: As in `Evidence`, float32.
        behind: As in `Evidence`, float32.
        weight: Summed weights of the hits, float32.
        mean: As in `Evidence`, float16.
        axes: As in `Evidence`, float16.
        change: As in `Evidence`, int8.
    """

    start: jax.Array
    hits: jax.Array
    passes: jax.Array
    behind: jax.Array
    weight: jax.Array
    mean: jax.Array
    axes: jax.Array
    change: jax.Array


def empty_grid(config: Config) -> Grid:
    """Makes a grid that no ray has met."""
    shape = config.grid_shape
    return Grid(
        evidence=Evidence(
            hits=jnp.zeros(shape, _STORED),
            passes=jnp.zeros(shape, _STORED),
            behind=jnp.zeros(shape, _STORED),
            root_weight=jnp.zeros(shape, _STORED),
            mean=jnp.zeros((*shape, 3), _STORED),
            axes=jnp.zeros((*shape, 3, 3), _STORED),
            change=jnp.zeros(shape, jnp.int8),
        ),
        derived=Derived(
            nearest=jnp.full((*shape, 3), NO_FEATURE, jnp.int8),
            sdf=jnp.full(shape, config.distance_horizon, _STORED),
            side=jnp.full(shape, Side.UNKNOWN, jnp.int8),
            doubt=jnp.full(shape, config.distance_horizon, _STORED),
            frontier_steps=jnp.full(shape, -FRONTIER_STEPS, jnp.int8),
        ),
    )


def read_window(config: Config, evidence: Evidence, rays: Rays) -> EvidenceWindow:
    """Reads the evidence within reach of the sensor, so that the work does not grow with the map.

    Args:
        config: The map's configuration.
        evidence: The evidence of the whole grid.
        rays: The cloud.

    Returns:
        The window.
    """
    reach = config.max_range + HIDDEN_VOXELS * config.voxel_size
    shape = geometry.window_shape(config, reach)
    start = geometry.window_start(config, shape, rays.sensor_world)

    def read(array: jax.Array) -> jax.Array:
        return geometry.read_window(array, start, shape)

    return EvidenceWindow(
        start=jnp.stack(start),
        hits=read(evidence.hits).astype(jnp.float32),
        passes=read(evidence.passes).astype(jnp.float32),
        behind=read(evidence.behind).astype(jnp.float32),
        weight=read(evidence.root_weight).astype(jnp.float32) ** 2,
        mean=read(evidence.mean),
        axes=read(evidence.axes),
        change=read(evidence.change),
    )


def whole_window(evidence: Evidence) -> EvidenceWindow:
    """Reads all of the evidence as one window, in float32."""
    return EvidenceWindow(
        start=jnp.zeros(3, jnp.int32),
        hits=evidence.hits.astype(jnp.float32),
        passes=evidence.passes.astype(jnp.float32),
        behind=evidence.behind.astype(jnp.float32),
        weight=evidence.root_weight.astype(jnp.float32) ** 2,
        mean=evidence.mean.astype(jnp.float32),
        axes=evidence.axes.astype(jnp.float32),
        change=evidence.change,
    )


def fade_evidence(config: Config, window: EvidenceWindow) -> EvidenceWindow:
    """Scales evidence down so that a voxel remembers at most `evidence_limit` rays.

    This bounds how many scans a vanished or a new surface needs to change the map.

    Args:
        config: The map's configuration.
        window: The window with new evidence.

    Returns:
        The window with scaled hits, weight, passes and behind.
    """
    # Compared as stored: rounding must not count as new evidence at the next update, so that
    # nothing fades where no ray passes.
    hits, passes = (rounded(counts) for counts in (window.hits, window.passes))
    above = hits + passes > _ROUNDING * config.evidence_limit
    total = jnp.maximum(window.hits + window.passes, 1)
    scale = jnp.where(above, config.evidence_limit / total, 1)
    return window._replace(
        hits=window.hits * scale,
        weight=window.weight * scale,
        passes=window.passes * scale,
        behind=jnp.minimum(window.behind, config.evidence_limit),
    )


def clear_patches(
    window: EvidenceWindow, voxels: jax.Array, change: int | jax.Array
) -> EvidenceWindow:
    """Removes patches; their voxels are free.

    Args:
        window: The window.
        voxels: Indices into the raveled window, (K,) int32, each once or more often; those at or
            above its size are skipped.
        change: Their `change` afterwards, one number or (K,).

    Returns:
        The window.
    """

    def put(array: jax.Array, values: float | jax.Array) -> jax.Array:
        return array.ravel().at[voxels].set(values, mode="drop").reshape(array.shape)

    passes = window.passes.ravel()[jnp.minimum(voxels, window.passes.size - 1)]
    return window._replace(
        hits=put(window.hits, 0),
        weight=put(window.weight, 0),
        behind=put(window.behind, 0),
        passes=put(window.passes, jnp.maximum(jnp.abs(passes), 1)),
        change=put(window.change, jnp.asarray(change, window.change.dtype)),
    )


def is_reached(passes: jax.Array, hits: jax.Array) -> jax.Array:
    """Returns a mask of the voxels that a ray has reached.

    Args:
        passes: Rays that went through the voxel, (...); negative where it is hidden again.
        hits: Rays that ended in it, (...).

    Returns:
        (...) bool.
    """
    return (passes > 0) | ((hits > 0) & (passes >= 0))


def is_free[A: (jax.Array, np.ndarray)](passes: A, behind: A, ratio: A | float = FREE_RATIO) -> A:
    """Returns a mask of the voxels that rays have shown to be free.

    Args:
        passes: Rays that went through the voxel, (...).
        behind: Rays that ended a little before it, (...).
        ratio: Least passes per ray that ended before the voxel, (...).

    Returns:
        (...) bool.
    """
    return (passes > 0) & (passes >= ratio * behind)


def is_observed[A: (jax.Array, np.ndarray)](config: Config, passes: A, hits: A, behind: A) -> A:
    """Returns a mask of the voxels that rays have shown to be free or to hold a surface.

    A few rays reach the voxels behind a surface, through noise or past an edge. They do not show
    on which side of the surface such a voxel lies.

    Args:
        config: The map's configuration.
        passes: Rays that went through the voxel, (...); negative where it is hidden again.
        hits: Rays that ended in it, (...).
        behind: Rays that ended a little before it, (...).

    Returns:
        (...) bool.
    """
    more = config.min_hits - 1 + _SURFACE_RATIO * behind
    surface = (hits >= config.min_hits) & (hits >= more)
    return (passes >= 0) & (is_free(passes, behind) | surface)


def rounded(values: jax.Array) -> jax.Array:
    """Rounds numbers as storing does; XLA may simplify a conversion there and back away."""
    kind = jnp.finfo(_STORED)
    return jax.lax.reduce_precision(values, kind.nexp, kind.nmant)


def write_window(evidence: Evidence, window: EvidenceWindow) -> Evidence:
    """Writes a window back.

    Args:
        evidence: The evidence of the whole grid.
        window: The window with new evidence.

    Returns:
        The evidence with the window's values, rounded to float16.
    """

    def write(old: jax.Array, values: jax.Array) -> jax.Array:
        return geometry.write_window(old, tuple(window.start), values.astype(old.dtype))

    return Evidence(
        hits=write(evidence.hits, window.hits),
        passes=write(evidence.passes, window.passes),
        behind=write(evidence.behind, window.behind),
        root_weight=write(evidence.root_weight, jnp.sqrt(window.weight)),
        mean=write(evidence.mean, window.mean),
        axes=write(evidence.axes, window.axes),
        change=write(evidence.change, window.change),
    )
