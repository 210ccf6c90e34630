"""The evidence of two grids added up, as if one map had met the rays of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow, fade_evidence
from hiosdf_jax._src.mapping.joining.doubles import drop_doubles, is_sure, is_surface
from hiosdf_jax._src.numerics.masks import where_leading
from hiosdf_jax._src.numerics.modes import cond
from hiosdf_jax._src.numerics.shifts import with_neighbors


class Moved(NamedTuple):
    """How the map of a window lies in the voxels of the sum.

    Attributes:
        coincides: Whether its voxels are voxels of the sum, () bool.
        passes_at: Looks up how many of its rays passed points: maps offsets from the centers of the
            sum's voxels, (X, Y, Z, 3) voxels, to counts (X, Y, Z).
    """

    coincides: jax.Array
    passes_at: Callable[[jax.Array], jax.Array]


def sum_evidence(
    config: Config, windows: Sequence[EvidenceWindow], moved: Sequence[Moved | None] = ()
) -> EvidenceWindow:
    """Adds up the evidence of windows over the same voxels.

    The maps do not say which of them is newer. So a thing that only one of them has met stays
    surface, however many rays of the others passed there.

    Args:
        config: The configuration of the sum.
        windows: One or more, not rounded.
        moved: For each window, how its map was moved; None, or no entry: not at all.

    Returns:
        Their sum, limited to `Config.evidence_limit` and not rounded.
    """
    moved = [*moved, *[None] * (len(windows) - len(moved))]
    apart = sum(map(_is_apart, moved), start=jnp.asarray(False))
    kept = _only_in_one(config, windows, apart)
    total = windows[0]
    for window in windows[1:]:
        if any(moved):
            kept |= is_surface(config, total) & is_sure(total)  # doubles of it are dropped
            total, window = cond(
                apart, partial(drop_doubles, config), lambda *both: both, total, window
            )
        total = _add(total, window)
    if any(moved):
        total = _count_passes(total, windows, moved)
    total = patches.keep_surfaces(config, total, kept & (total.hits > 0))
    surface = is_surface(config, total)
    return patches.keep_surfaces(config, fade_evidence(config, total), surface)


def _is_apart(moved: Moved | None) -> jax.Array:
    return jnp.asarray(False) if moved is None else ~moved.coincides


def _count_passes(
    total: EvidenceWindow, windows: Sequence[EvidenceWindow], moved: Sequence[Moved | None]
) -> EvidenceWindow:
    """Counts the rays of each map that passed the patches of the sum.

    Beside surfaces, a voxel of the sum overlaps unseen voxels of a moved map and has none of its
    passes. Stray hits of the other maps would stay there forever.
    """
    counts = [
        jnp.abs(window.passes) if its_move is None else its_move.passes_at(total.mean)
        for window, its_move in zip(windows, moved, strict=True)
    ]
    most = jnp.maximum(jnp.abs(total.passes), sum(counts))
    most = jnp.where(total.passes < 0, -most, most)
    return total._replace(passes=jnp.where(total.hits > 0, most, total.passes))


def _only_in_one(config: Config, windows: Sequence[EvidenceWindow], apart: jax.Array) -> jax.Array:
    """Finds surfaces of one of the windows that none of the others has beside them.

    Beside are neighboring voxels, and within two voxels where the maps' voxels are apart.

    Beside surfaces of others, noise and edges leave a few hits in voxels that most rays pass. There
    the sum decides, as in one map: 1.07 instead of 0.53 cm for a house in two halves otherwise.
    """
    shape = windows[0].hits.shape
    found, beside, several = (jnp.zeros(shape, bool) for _ in range(3))
    surfaces = [is_surface(config, window) for window in windows]
    for surface in surfaces:
        near = with_neighbors(surface)
        near |= apart & with_neighbors(near)
        beside, several = beside | near, several | (beside & near)
    for window, surface in zip(windows, surfaces, strict=True):
        # A surface is beside itself.
        found |= surface & (is_sure(window) | ~several)
    return found


def _add(first: EvidenceWindow, second: EvidenceWindow) -> EvidenceWindow:
    """Adds up the evidence of two windows.

    Hits, passes and weights are sums, and the moments of two patches add by Chan's rule. Where one
    of the windows knows nothing the other stays as it is. A voxel that one of them takes for hidden
    stays hidden: which of them is newer is not known.
    """
    one, other = first.hits > 0, second.hits > 0
    both = one & other
    weight = first.weight + second.weight
    part = second.weight / jnp.maximum(weight, 1e-30)
    step = second.mean - first.mean
    mean = first.mean + part[..., None] * step
    spread = _weighted(1 - part, _spread_of(first)) + _weighted(part, _spread_of(second))
    spread += _weighted(part * (1 - part), step[..., :, None] * step[..., None, :])
    facing = (1 - part)[..., None] * _normal_of(first) + part[..., None] * _normal_of(second)
    axes = patches.axes_of(spread.reshape(-1, 3, 3), facing.reshape(-1, 3)).reshape(spread.shape)

    def choose(merged: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
        return where_leading(both, merged, where_leading(other, b, a))

    hidden = (first.passes < 0) | (second.passes < 0)
    passes = jnp.abs(first.passes) + jnp.abs(second.passes)
    # The newer of two patches; without patches, the place that changed last.
    a, b = first.change, second.change
    recent = jnp.where(one | other, jnp.maximum(a, b), jnp.minimum(a, b))
    return EvidenceWindow(
        start=first.start,
        hits=first.hits + second.hits,
        passes=jnp.where(hidden, -passes, passes),
        behind=first.behind + second.behind,
        weight=weight,
        mean=choose(mean, first.mean, second.mean),
        axes=choose(axes, first.axes, second.axes),
        change=jnp.where(one == other, recent, jnp.where(one, a, b)),
    )


def _spread_of(window: EvidenceWindow) -> jax.Array:
    """Computes the covariance of the hits, (X, Y, Z, 3, 3) voxels^2."""
    return jnp.sum(window.axes[..., :, :, None] * window.axes[..., :, None, :], axis=-3)


def _normal_of(window: EvidenceWindow) -> jax.Array:
    """Computes the normals, (X, Y, Z, 3); 0 where there is no patch."""
    short = window.axes[..., 2, :]
    return short / jnp.maximum(jnp.linalg.norm(short, axis=-1, keepdims=True), 1e-6)


def _weighted(weight: jax.Array, matrices: jax.Array) -> jax.Array:
    return weight[..., None, None] * matrices
