"""Space that was free and is now hidden behind something new: it counts as unobserved again."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.change.directions import View
from hiosdf_jax._src.change.novelty import Novelty
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.evidence import EvidenceWindow, is_reached
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.modes import cond
from hiosdf_jax._src.numerics.shifts import with_neighbors
from hiosdf_jax._src.numerics.vectors import each, length, split

# A new thing hides free space up to this far behind its visible side, m: nothing is known of its
# depth, and what stood there before may still stand.
_HIDES_M = 1.5

# A voxel needs this many novel returns of one cloud: one or two are stray. Next to such a voxel one
# will do: it belongs to the same thing.
_LEAST_NOVEL_HITS = 3

# A surface counts as new for this many scans that see it.
_NEW_SCANS = 8

# A voxel that has hits and no passes is hidden by this many.
_LEAST_PASSES = 2.0**-8


def add_new_surfaces(
    config: Config, before: EvidenceWindow, window: EvidenceWindow, rays: Rays, novelty: Novelty
) -> tuple[EvidenceWindow, jax.Array]:
    """Lets returns from space that was free outweigh the rays that once passed there.

    Args:
        config: The map's configuration.
        before: The evidence before the cloud.
        window: The evidence with the cloud's hits and passes.
        rays: The cloud.
        novelty: The cloud compared with the map before it.

    Returns:
        The window, whose new surfaces forget old passes, and a mask of the rays that end on new
        surfaces or on the lowest part of a new thing, (N,) bool.
    """
    shape = window.hits.shape
    point_world = split(rays.points_world)
    index, inside = geometry.window_voxel_around(config, window.start, shape, point_world)
    voxel = geometry.flat_index(shape, index)
    target = jnp.where(novelty.novel & inside, voxel, window.hits.size)
    # Next to a new surface a single novel return will do: it belongs to the same thing.
    count = jnp.where(novelty.near_new, _LEAST_NOVEL_HITS, 1)
    novel_hits = jnp.zeros(window.hits.size, jnp.int32).at[target].add(count, mode="drop")
    novel_hits = novel_hits.reshape(shape)
    appeared = novel_hits >= _LEAST_NOVEL_HITS
    appeared |= (novel_hits > 0) & with_neighbors(appeared)

    new_hits = window.hits - before.hits
    new_passes = jnp.maximum(window.passes - jnp.abs(before.passes), 0)
    # Noise and edges let most of the rays of the same cloud pass.
    appeared &= new_hits >= config.min_hit_ratio * (new_hits + new_passes)
    seen = new_hits > 0
    # A hidden voxel in which rays end is observed again. If it held no surface, they are newer
    # evidence than the rays that passed there.
    known = jnp.where(before.hits >= config.min_hits, -window.passes, 0)
    passes = jnp.where(seen & (window.passes < 0), known, window.passes)
    older = jnp.where(seen & (window.change > 0), window.change - 1, window.change)
    change = jnp.where(appeared, jnp.int8(_NEW_SCANS), older)
    # The lowest part of a thing on the floor hides space too, but its voxels keep their passes. If
    # they were new, a LiDAR stream's error would be 0.1 cm larger at 5 to 20 cm from surfaces.
    new = change > 0
    at = jnp.where(inside, voxel, 0)
    joins = novelty.may_join & with_neighbors(new).ravel()[at]
    fresh = rays.ends & inside & (new.ravel()[at] | joins)
    window = window._replace(passes=jnp.where(appeared, new_passes, passes), change=change)
    return window, fresh


def hide_behind(
    config: Config,
    before: EvidenceWindow,
    window: EvidenceWindow,
    rays: Rays,
    view: View,
    fresh: jax.Array,
) -> EvidenceWindow:
    """Takes voxels behind new surfaces for unobserved, and shows them again when rays can see them.

    Args:
        config: The map's configuration.
        before: The evidence before the cloud.
        window: The evidence with the cloud's hits and passes.
        rays: The cloud.
        view: The cloud as seen from the sensor.
        fresh: The ray ends on a new surface or on the lowest part of a new thing, (N,) bool.

    Returns:
        The window; hidden voxels have negative passes.
    """

    def hide(window: EvidenceWindow) -> jax.Array:
        size = config.voxel_size
        measured, filled = view
        fresh_image = directions.range_image(rays, fresh)
        # Thin things hide little, and the image is too coarse to say what.
        solid = directions.dense_parts(rays, fresh)
        nearest = jnp.where(solid, fresh_image.nearest, jnp.inf)
        new = directions.spread_nearest(fresh_image._replace(nearest=nearest), measured)
        # Between rays that look past it, nothing says that a voxel is hidden.
        unsure = jnp.where(measured.farthest >= 0, -jnp.inf, filled.farthest)
        seen_past = jnp.where(jnp.isfinite(filled.nearest), filled.nearest, -jnp.inf)

        center_world = geometry.window_centers(config, window.start, window.hits.shape)
        offset = each(jnp.subtract, center_world, split(rays.sensor_world))
        distance, pixel = length(offset), directions.pixel_of(offset)
        behind = (new[pixel] < distance - 0.5 * size) & (new[pixel] > distance - _HIDES_M)
        sure = unsure[pixel] < distance - 0.5 * size
        shown = seen_past[pixel] > distance + 0.5 * size
        # Neither passed nor hit by this cloud.
        unmet = (window.passes == before.passes) & (window.hits == before.hits)
        hidden = unmet & behind & sure & is_reached(window.passes, window.hits)
        passes = jnp.where(hidden, -jnp.maximum(window.passes, _LEAST_PASSES), window.passes)
        return jnp.where(unmet & shown & ~behind, jnp.abs(passes), passes)

    needed = jnp.any(fresh) | jnp.any(before.passes < 0)
    passes = cond(needed, hide, lambda window: window.passes, window)
    return window._replace(passes=passes)
