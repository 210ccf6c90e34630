"""Hits of a vanished thing in the patches beside it.

A voxel of the floor also holds hits on the feet of a chair. When the chair is gone, nothing tells
them from the others. So while the change is recent, new hits outweigh old ones.
"""

from __future__ import annotations

import jax.numpy as jnp

from hiosdf_jax._src.change.vanishing import has_vanished, where_things_left
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import EvidenceWindow
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.modes import run_if
from hiosdf_jax._src.numerics.shifts import with_neighbors
from hiosdf_jax._src.numerics.vectors import split

# Old hits that remain per new one. With 0.5 instead of 0.25, 87 % of a chair's old place in the
# apartment is free after five scans, instead of all of it.
_OLD_PER_NEW = 0.25


def fade_leftovers(config: Config, window: EvidenceWindow, rays: Rays) -> EvidenceWindow:
    """Lets the hits of a cloud outweigh older ones, up to two voxels from where a thing has left.

    Hits, passes and behind are scaled alike: what was surface or free stays so. With the new hits,
    a patch has at least `min_hits`.

    Args:
        config: The map's configuration.
        window: The evidence before the cloud.
        rays: The cloud.

    Returns:
        The evidence to which the cloud is to be added.
    """
    vanished = has_vanished(window.change)

    def fade(window: EvidenceWindow) -> EvidenceWindow:
        shape, size = window.hits.shape, window.hits.size
        point_world = split(rays.points_world)
        index, inside = geometry.window_voxel_around(config, window.start, shape, point_world)
        voxel = jnp.where(rays.ends & inside, geometry.flat_index(shape, index), size)
        new = jnp.zeros(size, jnp.float32).at[voxel].add(1, mode="drop").reshape(shape)
        most = jnp.maximum(_OLD_PER_NEW * new, config.min_hits - new)
        share = jnp.minimum(most / jnp.maximum(window.hits, 1), 1)
        beside = with_neighbors(with_neighbors(vanished)) & where_things_left(window.change)
        share = jnp.where(beside & (new > 0) & (window.hits > 0), share, 1)
        return window._replace(
            hits=share * window.hits,
            weight=share * window.weight,
            passes=share * window.passes,
            behind=share * window.behind,
        )

    return run_if(jnp.any(vanished), fade, window, rays)
