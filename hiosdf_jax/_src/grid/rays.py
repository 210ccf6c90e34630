"""A cloud as rays in the world: where they begin and end, and what they tell of."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.numerics.vectors import length, split


class Beams(NamedTuple):
    """A cloud as rays in the world.

    Attributes:
        points_world: (N, 3) m, where they end.
        directions_world: (N, 3) unit vectors; 0 where there is no return.
        free_ranges: (N,) m, the part of them that counts as free.
        in_range: (N,) bool, finite and not nearer than min_range: tell of free space.
        ends: (N,) bool, in range and not farther than max_range: tell of a surface.
        inside: (N,) bool, end in the bounds.
        sensor_world: (3,) m, where they begin.
    """

    points_world: jax.Array
    directions_world: jax.Array
    free_ranges: jax.Array
    in_range: jax.Array
    ends: jax.Array
    inside: jax.Array
    sensor_world: jax.Array


def place_cloud(config: Config, cloud: jax.Array, finite: jax.Array, pose: jax.Array) -> Beams:
    """Takes a cloud to the world.

    Args:
        config: The map's configuration.
        cloud: (N, 3) m, sensor frame.
        finite: (N,) bool; other rows are no returns.
        pose: (4, 4) T_world_sensor.

    Returns:
        The rays.
    """
    cloud = jnp.where(finite[:, None], cloud, 0)
    sensor_world = pose[:3, 3]
    offsets_world = jnp.sum(cloud[:, None, :] * pose[:3, :3], axis=-1)
    # Not the cloud's own: a pose that is rigid but for rounding must not take rays out of reach.
    ranges = length(split(offsets_world))
    in_range = finite & (ranges >= config.min_range)
    points_world = sensor_world + offsets_world
    _, _, inside = geometry.voxel_of(config, points_world)
    return Beams(
        points_world=points_world,
        directions_world=offsets_world / jnp.maximum(ranges, 1e-6)[:, None],
        free_ranges=jnp.minimum(ranges, config.max_range),
        in_range=in_range,
        ends=in_range & (ranges <= config.max_range),
        inside=inside,
        sensor_world=sensor_world,
    )
