"""A cloud as rays in the world frame."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.numerics.robot_and_noise import is_on_robot
from hiosdf_jax._src.numerics.vectors import length, split

HIDDEN_VOXELS = 4
"""A ray changes no voxel farther than this behind its end."""


class Rays(NamedTuple):
    """A cloud as rays from the sensor.

    Attributes:
        points_world: End points, (N, 3) m.
        directions_world: Unit vectors, (N, 3); 0 where there is no return.
        free_ranges: Length of the part that counts as free space, (N,) m.
        in_range: The return is finite and not nearer than min_range, (N,) bool; the ray clears
            space.
        ends: The return is in range and not farther than max_range, (N,) bool; it is on a surface.
        inside: The end point lies in the bounds, (N,) bool.
        sigma: Standard deviation of the range, (N,) m.
        sensor_world: Common origin, (3,) m.
    """

    points_world: jax.Array
    directions_world: jax.Array
    free_ranges: jax.Array
    in_range: jax.Array
    ends: jax.Array
    inside: jax.Array
    sigma: jax.Array
    sensor_world: jax.Array


def place_cloud(
    config: Config,
    cloud: jax.Array,
    finite: jax.Array,
    pose: jax.Array,
    noise: jax.Array | None = None,
) -> Rays:
    """Transforms a cloud to the world frame.

    Args:
        config: The map's configuration.
        cloud: (N, 3) m, sensor frame.
        finite: (N,) bool; other rows are not returns.
        pose: (4, 4) T_world_sensor.
        noise: (a, b) of the standard deviation a + b r^2 at range r, m and 1/m; that of the
            configuration by default.

    Returns:
        The rays.
    """
    noise_floor, noise_growth = config.range_noise if noise is None else noise
    cloud = jnp.where(finite[:, None], cloud, 0)
    sensor_world = pose[:3, 3]
    offsets_world = jnp.sum(cloud[:, None, :] * pose[:3, :3], axis=-1)
    # Measured in the world: a pose that is rigid up to rounding must not move rays out of reach.
    ranges = length(split(offsets_world))
    in_range = finite & (ranges >= config.min_range)
    points_world = sensor_world + offsets_world
    _, _, inside = geometry.voxel_of(config, points_world)
    free_ranges = jnp.minimum(ranges, config.max_range)
    return Rays(
        points_world=points_world,
        directions_world=offsets_world / jnp.maximum(ranges, 1e-6)[:, None],
        free_ranges=free_ranges,
        in_range=in_range,
        ends=in_range & (ranges <= config.max_range),
        inside=inside,
        sigma=noise_floor + noise_growth * free_ranges**2,
        sensor_world=sensor_world,
    )


def remove_robot(rays: Rays, centers_world: jax.Array, radii: jax.Array) -> Rays:
    """Removes the returns on the robot itself: they leave no surface and clear no space.

    Args:
        rays: The cloud.
        centers_world: Centers of the robot's spheres, (K, 3) m.
        radii: Their radii, (K,) m.

    Returns:
        The rays; those that end on the robot are not in range.
    """
    found = is_on_robot(rays.points_world, rays.sigma, centers_world, radii)
    return rays._replace(in_range=rays.in_range & ~found, ends=rays.ends & ~found)
