"""What the rays leave in the grid: kept in float16, and added to in float32 around the sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import carving, geometry
from hiosdf_jax._src.grid.distance import NO_FEATURE
from hiosdf_jax._src.state import Grid, Surface

# Half the memory, and finer than the noise.
_STORED = jnp.float16

# Such numbers are at most 1 + 2^-11 = 1.0005 times what they were rounded from.
_ROUNDING = 1.0007


def empty_grid(config: Config) -> Grid:
    """A grid that no ray has met."""
    shape = config.grid_shape
    return Grid(
        hits=jnp.zeros(shape, _STORED),
        passes=jnp.zeros(shape, _STORED),
        behind=jnp.zeros(shape, _STORED),
        weight=jnp.zeros(shape, _STORED),
        surface=Surface(
            mean=jnp.zeros((*shape, 3), _STORED),
            axes=jnp.zeros((*shape, 3, 3), _STORED),
            nearest=jnp.full((*shape, 3), NO_FEATURE, jnp.int8),
            sdf=jnp.full(shape, config.distance_horizon, _STORED),
            doubt=jnp.full(shape, config.distance_horizon, _STORED),
            frontier=jnp.full(shape, -geometry.FRONTIER_STEPS, jnp.int8),
        ),
    )


def read_evidence(config: Config, grid: Grid, sensor_world: jax.Array) -> tuple[jax.Array, Grid]:
    """Cuts out what a cloud can change, so that the work does not grow with the map.

    Args:
        config: The map's configuration.
        grid: The grid.
        sensor_world: (3,) m.

    Returns:
        start: (3,) int32, the window's first voxel.
        window: The grid within reach of the sensor; what the rays count in float32, since one
            cloud may add more than float16 holds, and `weight` squared.
    """
    shape = geometry.window_shape(
        config, config.max_range + carving.HIDDEN_VOXELS * config.voxel_size
    )
    start = geometry.window_start(config, shape, sensor_world)
    window = jax.tree.map(lambda array: geometry.read_window(array, start, shape), grid)
    return jnp.stack(start), window.replace(
        hits=window.hits.astype(jnp.float32),
        passes=window.passes.astype(jnp.float32),
        behind=window.behind.astype(jnp.float32),
        weight=window.weight.astype(jnp.float32) ** 2,
    )


def fade_evidence(config: Config, window: Grid) -> Grid:
    """Lets old evidence fade so that a voxel remembers `evidence_limit` rays.

    That bounds how long a surface that has vanished, or appeared, has to be seen to be believed.

    Args:
        config: The map's configuration.
        window: The grid, or the part of it that has new evidence.

    Returns:
        The window with scaled hits, weight, passes and behind.
    """
    # As they will be stored: what rounding adds then is not taken for new evidence the next time,
    # so that nothing fades where no ray comes by.
    hits, passes = (_rounded(counts) for counts in (window.hits, window.passes))
    above = hits + passes > _ROUNDING * config.evidence_limit
    total = jnp.maximum(window.hits + window.passes, 1)
    scale = jnp.where(above, config.evidence_limit / total, 1)
    return window.replace(
        hits=window.hits * scale,
        weight=window.weight * scale,
        passes=window.passes * scale,
        behind=jnp.minimum(window.behind, config.evidence_limit),
    )


def _rounded(values: jax.Array) -> jax.Array:
    """What storing will make of them; converting there and back may be simplified away."""
    kind = jnp.finfo(_STORED)
    return jax.lax.reduce_precision(values, kind.nexp, kind.nmant)


def write_evidence(grid: Grid, start: jax.Array, window: Grid) -> Grid:
    """Puts the window back; weights as their roots, since those of far returns are very small.

    Args:
        grid: The grid that it was cut from.
        start: (3,) int32, the window's first voxel.
        window: The window with new hits, passes, behind, weight, mean and axes.

    Returns:
        The grid.
    """

    def put(old: jax.Array, values: jax.Array) -> jax.Array:
        return geometry.write_window(old, tuple(start), values.astype(old.dtype))

    return grid.replace(
        hits=put(grid.hits, window.hits),
        passes=put(grid.passes, window.passes),
        behind=put(grid.behind, window.behind),
        weight=put(grid.weight, jnp.sqrt(window.weight)),
        surface=grid.surface.replace(
            mean=put(grid.surface.mean, window.surface.mean),
            axes=put(grid.surface.axes, window.surface.axes),
        ),
    )
