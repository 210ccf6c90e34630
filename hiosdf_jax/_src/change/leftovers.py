"""Hits of a thing that has left, in patches that stay.

A voxel of the floor also holds hits on the feet of a chair. When the chair is gone, nothing tells
these hits from those on the floor. So new hits outweigh old ones while the change is recent.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change.vanishing import has_vanished, where_things_left
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.grid.evidence import EvidenceWindow
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.modes import run_if
from hiosdf_jax._src.numerics.shifts import with_neighbors
from hiosdf_jax._src.numerics.vectors import split

# Old hits count as at most this many per new one. With 0.25 instead of 0.1, 97 % of a chair's old
# place in the apartment is free after five scans.
_OLD_PER_NEW = 0.1


def fade_leftovers(config: Config, window: EvidenceWindow, rays: Rays) -> EvidenceWindow:
    """Lets the hits of a cloud outweigh older ones, up to two voxels from where a thing has left.

    Only the weight by which hits are averaged changes. The counts of rays stay: what is surface or
    free does not depend on it. Small patches, such as those of poles, keep their weight, by which
    they are told from noise.

    Args:
        config: The map's configuration.
        window: The evidence before the cloud.
        rays: The cloud.

    Returns:
        The evidence to which the cloud is to be added.
    """
    vanished = has_vanished(window.change)

    def fade(weight: jax.Array) -> jax.Array:
        shape, size = window.hits.shape, window.hits.size
        point_world = split(rays.points_world)
        index, inside = geometry.window_voxel_around(config, window.start, shape, point_world)
        voxel = jnp.where(rays.ends & inside, geometry.flat_index(shape, index), size)
        new = jnp.zeros(size, jnp.float32).at[voxel].add(1, mode="drop").reshape(shape)
        share = jnp.minimum(_OLD_PER_NEW * new / jnp.maximum(window.hits, 1), 1)
        beside = with_neighbors(with_neighbors(vanished)) & where_things_left(window.change)
        fades = beside & (new > 0) & ~patches.is_small(window.axes)
        return jnp.where(fades, share * weight, weight)

    weight = run_if(jnp.any(vanished), fade, window.weight, window, rays)
    return window._replace(weight=weight)
