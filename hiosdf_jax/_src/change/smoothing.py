"""Ranges with large noise, averaged over neighboring rays.

Noise of half a voxel would leave several layers of patches at each wall, and the nearest layer
would count. Neighboring rays that meet the same plane agree on it: the inverse range of a plane is
linear in the direction of the ray. Such planes cut edges off. The mean of what they leave brings
most of an edge back.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change.directions import EDGE, pixel_of
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.vectors import dot, length, split

# Rays up to this many pixels away (0.7 degrees each) are averaged where their mean ranges differ by
# at most this many standard deviations of a range.
_REACH_PIXELS = 3
_SAME_SURFACE = 3.0

# Smaller noise, in voxels, averages out within a patch.
_LEAST_NOISE_VOXELS = 0.2

# Slopes across directions that few rays span are kept small: this much is added to the variance of
# the directions, rad^2.
_RIDGE = 1e-5


def smooth_ranges(config: Config, rays: Rays) -> Rays:
    """Replaces ranges by those of planes through the rays around them.

    The differences between ranges and planes are averaged in the same way, and added.

    Args:
        config: The map's configuration.
        rays: The cloud.

    Returns:
        The cloud, with other points where the noise is large.
    """
    ranges = length(split(rays.points_world - rays.sensor_world))
    noisy = rays.ends & (rays.sigma > _LEAST_NOISE_VOXELS * config.voxel_size)
    pixel = jnp.where(noisy, pixel_of(split(rays.directions_world)), EDGE**2)
    inverse = 1 / jnp.maximum(ranges, 1e-3)

    # Sums in each pixel: count, inverse range, sigma, directions, and their products.
    x, y, z = split(rays.directions_world)
    terms = (x, y, z, inverse)
    products = [a * b for a, b in itertools.combinations_with_replacement(terms, 2)][:-1]
    columns = jnp.stack([jnp.ones_like(x), rays.sigma, ranges, *terms, *products])
    sums = jnp.zeros((len(columns), EDGE**2), jnp.float32).at[:, pixel].add(columns, mode="drop")
    sums = sums.reshape(-1, EDGE, EDGE)
    count = jnp.maximum(sums[0], 1)
    sigma, mean_range = sums[1] / count, jnp.where(sums[0] > 0, sums[2] / count, jnp.inf)

    def around(sums: jax.Array) -> jax.Array:
        """Adds up the pixels around each ray, (C, E, E) to (C, N)."""
        margin = (_REACH_PIXELS, _REACH_PIXELS)
        padded = jnp.pad(sums, ((0, 0), margin, margin))
        padded_range = jnp.pad(mean_range, (margin, margin), constant_values=jnp.inf)
        total = jnp.zeros_like(sums)
        for line, column in itertools.product(range(2 * _REACH_PIXELS + 1), repeat=2):
            window = slice(line, line + EDGE), slice(column, column + EDGE)
            same = jnp.abs(padded_range[window] - mean_range) <= _SAME_SURFACE * sigma
            total += jnp.where(same, padded[:, *window], 0)
        return total.reshape(len(sums), -1)[:, jnp.minimum(pixel, EDGE**2 - 1)]

    smooth = _predict(around(sums), (x, y, z))
    moved = noisy & (jnp.abs(1 / smooth - ranges) <= _SAME_SURFACE * rays.sigma)
    smooth = 1 / jnp.where(moved, smooth, 1)
    # A plane across a convex edge lies behind it. The mean of what the planes around a ray leave
    # moves the surface back (Tukey's twicing).
    left = jnp.stack([moved, jnp.where(moved, ranges - smooth, 0)]).astype(jnp.float32)
    left = jnp.zeros((2, EDGE**2), jnp.float32).at[:, pixel].add(left, mode="drop")
    count, offset = around(left.reshape(-1, EDGE, EDGE))
    ranges = jnp.where(moved, smooth + offset / jnp.maximum(count, 1), ranges)
    points_world = jnp.where(
        moved[:, None],
        rays.sensor_world + ranges[:, None] * rays.directions_world,
        rays.points_world,
    )
    _, _, inside = geometry.voxel_of(config, points_world)
    return rays._replace(
        points_world=points_world,
        free_ranges=jnp.where(moved, jnp.minimum(ranges, config.max_range), rays.free_ranges),
        ends=rays.ends & (ranges <= config.max_range),
        inside=inside,
    )


def _predict(sums: jax.Array, direction: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
    """Evaluates the least-squares fit of inverse ranges, linear in the direction.

    Args:
        sums: Sums over the rays around each ray: count, sigma, range, then (x, y, z, q) and the
            upper triangle of their products without q^2, (16, N).
        direction: Unit vectors, (N,) each.

    Returns:
        Inverse ranges, (N,) 1/m.
    """
    count = jnp.maximum(sums[0], 1)
    mx, my, mz, mq = (sums[k] / count for k in range(3, 7))
    xx, xy, xz, xq, yy, yz, yq, zz, zq = (sums[k] / count for k in range(7, 16))
    a, b, c = xx - mx * mx + _RIDGE, xy - mx * my, xz - mx * mz
    d, e, f = yy - my * my + _RIDGE, yz - my * mz, zz - mz * mz + _RIDGE
    u, v, w = xq - mx * mq, yq - my * mq, zq - mz * mq
    # The symmetric matrix's cofactors.
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * ca + b * cb + c * cc
    slope = (
        (ca * u + cb * v + cc * w) / determinant,
        (cb * u + cd * v + ce * w) / determinant,
        (cc * u + ce * v + cf * w) / determinant,
    )
    offset = (direction[0] - mx, direction[1] - my, direction[2] - mz)
    return jnp.maximum(mq + dot(slope, offset), 1e-3)
