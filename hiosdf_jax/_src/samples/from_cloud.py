"""Training samples from the newest cloud: the local SDF (paper, section IV-C)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.vectors import length, split
from hiosdf_jax._src.samples.draw import Samples, draw_from_mask, draw_words, uniform

# Cloud points per comparison with all queries on a CPU; they stay in a core's cache. Measured on
# two cores with 20,000 queries and 50,000 points: 0.24 s, one query at a time 3.6 s. A GPU compares
# all points by one kernel.
_TILE = 2048


def sample_cloud(config: Config, rays: Rays, key: jax.Array) -> Samples:
    """Draws stratified samples on rays of the newest cloud, with their distance to the cloud.

    The sign is + before the end of the ray and - behind it (equation 1). The magnitude is the
    distance to the nearest point of the whole cloud (equation 2).

    Args:
        config: The map's configuration.
        rays: The cloud; rows that do not end on a surface are ignored.
        key: Source of randomness.

    Returns:
        local_points * local_ray_samples samples; those at local_truncation or more from the cloud
        have weight 0.
    """
    points_world, valid, sensor_world = rays.points_world, rays.ends, rays.sensor_world
    shape = (config.local_points, config.local_ray_samples)
    choice_words, depth_words = draw_words(key, shape[:1], shape)
    ranges = length(split(points_world - sensor_world))
    eligible = valid & (ranges < config.local_max_range)
    chosen, possible = draw_from_mask(eligible, choice_words)
    ends, end_ranges = points_world[chosen], ranges[chosen]
    directions = (ends - sensor_world) / jnp.maximum(end_ranges, 1e-6)[:, None]

    first = jnp.arange(shape[1], dtype=jnp.float32)
    strata = (first + uniform(depth_words)) / shape[1]
    depths = strata * (end_ranges[:, None] + config.local_truncation)
    queries_world = sensor_world + depths[..., None] * directions[:, None, :]
    queries_world = queries_world.reshape(-1, 3)

    distance = nearest_distance(queries_world, points_world, valid)
    sign = jnp.where(depths < end_ranges[:, None], 1.0, -1.0).ravel()
    kept = possible & (distance < config.local_truncation)
    # Not inf where there is no cloud: inf times weight 0 is NaN.
    return Samples(queries_world, jnp.where(possible, sign * distance, 0), kept.astype(jnp.float32))


def nearest_distance(queries: jax.Array, points: jax.Array, valid: jax.Array) -> jax.Array:
    """Computes distances to the nearest point of a cloud by brute force.

    Args:
        queries: (Q, 3) m.
        points: (N, 3) m.
        valid: (N,) bool; other points are ignored.

    Returns:
        (Q,) m; inf if no point is valid.
    """
    # Far away, but not inf: inf - inf would be NaN.
    points = jnp.where(valid[:, None], points, 1e15)
    on_cpu = jax.default_backend() == "cpu"
    size = min(_TILE, points.shape[0]) if on_cpu else points.shape[0]
    points = jnp.pad(points, ((0, -points.shape[0] % size), (0, 0)), mode="edge")

    def compare(least: jax.Array, tile: jax.Array) -> tuple[jax.Array, None]:
        square = sum((tile[:, k] - queries[:, k, None]) ** 2 for k in range(3))
        return jnp.minimum(least, jnp.min(square, axis=1)), None

    start = jnp.full(queries.shape[0], jnp.inf, jnp.result_type(queries, points))
    start = varying_like(start, queries, points)
    square, _ = jax.lax.scan(compare, start, points.reshape(-1, size, 3))
    return jnp.where(square < 1e29, jnp.sqrt(square), jnp.inf)
