"""Answers of a live map: the grid and the network, blended into one distance.

Near surfaces the grid's patches are more accurate, and the network smooths the edges between them.
Beyond the grid's horizon the answer fades to that of the network. It also does so in unseen space,
where the grid guesses the side of a surface and the guess may jump. Where unseen space is an
obstacle, it fades to the frontier there.

`lattice` has the same functions for a baked field: `bounds`, `sdf`, `frontier`, `is_certain`,
`lower`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Bounds, Config
from hiosdf_jax._src.grid import interpolation, lookup
from hiosdf_jax._src.network import siren
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.state.pytrees import Field, Unknown

# The grid's answer fades out between these shares of its horizon.
_FADE = (0.8, 1.0)

# It fades out at these distances beyond observed space, voxels: space just behind a surface is
# certainly solid. The network may still remember the free space in which a thing has appeared. Its
# gradient would point into the thing, so an obstacle's distance fades to the frontier.
_FADE_UNSEEN_VOXELS = {"network": (1.0, 3.0), "obstacle": (2.0, 4.0)}

# Largest correction of the grid by the network, voxels: in unseen space the network is a guess.
_LARGEST_CORRECTION_VOXELS = 1.0

# So near to a surface the grid answers alone, voxels. Otherwise the network lifts the distance at
# thin things.
_SURFACE_VOXELS = 0.2

# Where rays contradict each other about free space, and beside the edges of some patches, the sign
# may change without a surface. Points are not observed if all patches are farther than the first
# number, voxels, and the distance of the grid is below the second one, voxels, or below the share
# of the distance to the patches. That leaves out 0.07 % of house_depth. With 0.4 instead of 0.35,
# one sign change of a million was half a voxel from the mesh.
_NO_SURFACE_VOXELS = 0.35
_NEAR_ZERO_VOXELS = 0.1
_NEAR_ZERO_SHARE = 0.2

# Terms of the error scale, beside the spread of the hits. Measured over a depth and a LiDAR stream:
# the bound that holds for 99 % of the points varies least between the two, and is smallest.
_LEAST_SCALE_VOXELS = 0.3
_GAP_SHARE = 0.5

# An unseen surface is assumed at most this much nearer than any observed one: with more, the mean
# bound falls faster than the errors. Within 2.5 voxels of unseen space the assumption grows, since
# the nearest surface may well lie in it. With 0.15 and 0.8, the bound of house_depth holds for 96.6
# instead of 97.4 % of the points after 6 frames.
_HIDDEN_VOXELS = 0.15
_HIDDEN_BESIDE_VOXELS = 1.0
_BESIDE_VOXELS = 2.5


def bounds(field: Field) -> Bounds:
    """Returns the corners of the mapped box, m, world frame."""
    return field.config.bounds


def sdf(field: Field, points_world: jax.Array, unknown: Unknown) -> jax.Array:
    """Computes the blended signed distance.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.
        unknown: The policy for unseen space that the distance is for.

    Returns:
        (...) m. Differentiable.
    """
    config = field.config
    network = network_sdf(field, points_world)
    if config.grid_share == 0:
        return network
    # Two kernels on a GPU: one for both takes a fifth longer on an H200.
    grid = lookup.grid_sdf(config, field.surface, points_world)
    unseen = frontier(field, points_world)
    grid, network, unseen = map(compute_once, (grid, network, unseen))
    return _combine(config, grid, network, unseen, unknown)


def frontier(field: Field, points_world: jax.Array) -> jax.Array:
    """Computes the distance to unseen space.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m. Differentiable.
    """
    return interpolation.frontier_distance(field.config, field.surface, points_world)


def is_certain(field: Field, points_world: jax.Array) -> jax.Array:
    """Returns a mask of the points whose sign is certain.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) bool.
    """
    config = field.config
    nearest = lookup.nearest_patch(config, field.surface, points_world)
    # Without a patch the distance is infinite.
    share = _NEAR_ZERO_SHARE * jnp.minimum(nearest.distance, config.distance_horizon)
    near_zero = jnp.abs(nearest.sdf) < jnp.maximum(_NEAR_ZERO_VOXELS * config.voxel_size, share)
    return ~near_zero | (nearest.distance <= _NO_SURFACE_VOXELS * config.voxel_size)


def lower(field: Field, points_world: jax.Array) -> jax.Array:
    """Computes a lower bound of the true distance in observed space.

    The bound is cautious - optimism * scale. `mapping.calibration` measures the optimism.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m.
    """
    cautious, scale = cautious_sdf(field, points_world)
    unseen = frontier(field, points_world)
    # Returns, which calibrate the optimism, say nothing about hidden surfaces: it is not lowered by
    # this.
    beside = jnp.clip(_BESIDE_VOXELS - unseen / field.config.voxel_size, 0, 1)
    nearer = _HIDDEN_BESIDE_VOXELS * field.config.voxel_size * beside
    return _expect_hidden(cautious, unseen, nearer) - field.optimism * scale


def network_sdf(field: Field, points_world: jax.Array) -> jax.Array:
    """Computes the signed distance of the network alone.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m.
    """
    return siren.predict(field.config, field.params, points_world - field.origin_world)


def cautious_sdf(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes the distance to everything that may be a surface, and the scale of its error.

    Carved surfaces and surfaces that were hit once count. The scale grows where grid and network
    disagree, and where the hits of a patch are scattered.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        The distance (...) m and the scale (...) m, > 0.
    """
    config = field.config
    nearest = lookup.nearest_patch(config, field.surface, points_world)
    network = network_sdf(field, points_world)
    limit = _LARGEST_CORRECTION_VOXELS * config.voxel_size
    gap = jnp.minimum(jnp.abs(network - nearest.sdf), limit)
    scale = _LEAST_SCALE_VOXELS * config.voxel_size + _GAP_SHARE * gap + nearest.spread
    doubt = interpolation.doubt_distance(config, field.surface, points_world)
    unseen = frontier(field, points_world)
    nearest, network, doubt, unseen = map(compute_once, (nearest, network, doubt, unseen))
    cautious = jnp.minimum(_combine(config, nearest.sdf, network, unseen, "network"), doubt)
    return _expect_hidden(cautious, unseen, _HIDDEN_VOXELS * config.voxel_size), scale


def _expect_hidden(cautious: jax.Array, unseen: jax.Array, nearer: jax.Array | float) -> jax.Array:
    """Lowers a distance, since unseen space may hide a surface that is this much nearer, m."""
    return jnp.minimum(cautious, jnp.maximum(unseen, cautious - nearer))


def _combine(
    config: Config, grid: jax.Array, network: jax.Array, frontier: jax.Array, unknown: Unknown
) -> jax.Array:
    """Blends the distances of grid and network."""
    if config.grid_share == 0:
        return network
    # The correction is at most the distance beyond that: surfaces stay where they are.
    away = jnp.maximum(jnp.abs(grid) - _SURFACE_VOXELS * config.voxel_size, 0)
    limit = jnp.minimum(_LARGEST_CORRECTION_VOXELS * config.voxel_size, away)
    near = grid + (1 - config.grid_share) * jnp.clip(network - grid, -limit, limit)
    start, end = (share * config.distance_horizon for share in _FADE)
    far = jnp.clip((jnp.abs(grid) - start) / (end - start), 0, 1)
    start, end = (voxels * config.voxel_size for voxels in _FADE_UNSEEN_VOXELS[unknown])
    unseen = jnp.clip((-frontier - start) / (end - start), 0, 1)
    if unknown == "network":
        return near + jnp.maximum(far, unseen) * (network - near)
    near = near + far * (network - near)
    return near + unseen * jnp.maximum(frontier - near, 0)
