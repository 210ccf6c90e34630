"""One surface in two grids: patches that lie on a sure patch of the other grid.

Where the voxels of two maps do not coincide, their patches of one wall may lie in different voxels.
Both together would be a thicker wall. In one map, the hits of both would have shared a voxel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow, rounded
from hiosdf_jax._src.numerics.masks import where_leading
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.vectors import dot, each, length, split, unit

# A patch of this many hits, on which this share of the rays ended, is surface whatever lies beside.
_SURE_HITS = 10.0
_SURE_RATIO = 0.5

# The center of a double is at most this far from the other patch, voxels.
_MOST_VOXELS = 0.7

# A voxel whose patch is dropped counts this many passes: it is seen. Its hits count as rays that
# ended before it: they did not show it to be free.
_SEEN = 2.0**-8


def is_surface(config: Config, window: EvidenceWindow) -> jax.Array:
    """Returns a mask of the patches that count as surface once they are stored, (X, Y, Z)."""
    hits, passes, root_weight, axes = (
        rounded(x) for x in (window.hits, window.passes, jnp.sqrt(window.weight), window.axes)
    )
    return patches.is_feature(config, hits, passes, root_weight**2, axes)


def is_sure(window: EvidenceWindow) -> jax.Array:
    """Returns a mask of the patches that are surface whatever the other maps say, (X, Y, Z)."""
    rays = window.hits + jnp.abs(window.passes)
    return (window.hits >= _SURE_HITS) & (window.hits >= _SURE_RATIO * rays)


def drop_doubles(
    config: Config, first: EvidenceWindow, second: EvidenceWindow
) -> tuple[EvidenceWindow, EvidenceWindow]:
    """Drops the patches that lie on a sure patch of the other window in a neighboring voxel.

    The sure patch must face the same side and have more weight. It is never dropped itself. If the
    caller keeps it, a surface stays within 0.7 voxels of the center of each dropped patch.

    Args:
        config: The map's configuration.
        first: Evidence over some voxels.
        second: Evidence over the same voxels.

    Returns:
        Both windows, without the hits of these patches. Their voxels stay observed.
    """
    in_first, in_second = is_surface(config, first), is_surface(config, second)
    sure_first, sure_second = is_sure(first), is_sure(second)
    here = _lies_on(first, second, in_second & sure_second) & ~in_second & ~sure_first
    there = _lies_on(second, first, in_first & sure_first) & ~in_first & ~sure_second
    return _without(first, here), _without(second, there)


def _lies_on(window: EvidenceWindow, other: EvidenceWindow, surface: jax.Array) -> jax.Array:
    """Returns a mask of the patches of a window that lie on weightier ones of the other, (X, Y, Z).

    Args:
        window: Evidence.
        other: Evidence over the same voxels.
        surface: The patches of it that count, (X, Y, Z) bool.
    """
    shape = window.hits.shape
    axes = [split(other.axes[..., k, :].astype(jnp.float32)) for k in range(3)]
    columns = [
        jnp.where(surface, other.weight, 0),
        *split(other.mean.astype(jnp.float32)),
        *axes[0],
        *axes[1],
        *unit(axes[2]),
    ]
    padded = jnp.pad(jnp.stack(columns), [(0, 0), (1, 1), (1, 1), (1, 1)])
    center = split(window.mean.astype(jnp.float32))
    normal = unit(split(window.axes[..., 2, :].astype(jnp.float32)))

    def compare(k: jax.Array, found: jax.Array) -> jax.Array:
        step = (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)
        start = (jnp.zeros_like(k), *(s + 1 for s in step))
        near = jax.lax.dynamic_slice(padded, start, (padded.shape[0], *shape))
        weight = near[0]
        mean, long, middle, facing = ((near[i], near[i + 1], near[i + 2]) for i in (1, 4, 7, 10))
        point = each(lambda c, s: c - s.astype(jnp.float32), center, step)
        own = each(jnp.zeros_like, mean)
        apart = patches.nearest_on_patch(point, mean, (long, middle), own).offset
        on = (length(apart) < _MOST_VOXELS) & (dot(normal, facing) > 0)
        return found | (on & (weight > window.weight))

    start = varying_like(jnp.zeros(shape, bool), window, other)
    return (window.hits > 0) & jax.lax.fori_loop(0, 27, compare, start)


def _without(window: EvidenceWindow, dropped: jax.Array) -> EvidenceWindow:
    """Returns the evidence without some patches."""

    def clear(values: jax.Array) -> jax.Array:
        return where_leading(~dropped, values, 0)

    return window._replace(
        hits=clear(window.hits),
        passes=jnp.where(dropped & (window.passes == 0), _SEEN, window.passes),
        behind=jnp.where(dropped, window.behind + jnp.maximum(window.hits, 1), window.behind),
        weight=clear(window.weight),
        mean=clear(window.mean),
        axes=clear(window.axes),
        change=clear(window.change),
    )
