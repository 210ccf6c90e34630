"""What is served to a planner: the grid and the network, combined into one distance.

Near surfaces the grid's patches are the more accurate, and the network smooths the edges between
them; beyond the grid's horizon the network goes on alone, and where nothing has been seen, since
the side of a surface is a guess of the grid's there that may jump.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import lookup
from hiosdf_jax._src.network import siren
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.state import Field

# Where the grid's answer fades out, as shares of its horizon.
_FADE = (0.8, 1.0)

# As far beyond what was seen, voxels: what lies just behind a surface is sure to be inside.
_FADE_UNSEEN_VOXELS = (1.0, 3.0)

# The network may correct the grid by so much, voxels: in unseen space it is a guess.
_LARGEST_CORRECTION_VOXELS = 1.0

# The scale of the error: these, and the spread of the hits. Measured over a depth and a LiDAR
# stream: what 99 % of the points need has the least spread between the two, and the least mean.
_LEAST_SCALE_VOXELS = 0.3
_GAP_SHARE = 0.5

# How much nearer than any seen surface an unseen one is taken to be, if there is room for it: with
# more, the mean bound falls faster than the errors.
_HIDDEN_VOXELS = 0.3


def network_sdf(field: Field, points_world: jax.Array) -> jax.Array:
    """Signed distance by the network alone.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m.
    """
    return siren.predict(field.config, field.params, points_world - field.origin_world)


def network_sdf_and_grad(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Signed distance by the network alone, and its gradient.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        The distance (...) m and its gradient (..., 3).
    """
    return value_and_gradient(lambda points: network_sdf(field, points), points_world)


def served_sdf(field: Field, points_world: jax.Array) -> jax.Array:
    """Signed distance that queries answer.

    Args:
        field: The field.
        points_world: (..., 3) m, inside the bounds.

    Returns:
        (...) m. Differentiable.
    """
    config = field.config
    network = network_sdf(field, points_world)
    if config.grid_share == 0:
        return network
    grid = lookup.grid_sdf(config, field.surface, points_world)
    return _combine(config, grid, network, lookup.frontier(config, field.surface, points_world))


def cautious_sdf(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance to all that may be a surface, and the scale of its error.

    What the rays carved away, or met only once, counts here. Grid and network err where they
    disagree, and where the hits behind a patch are scattered.

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
    doubt = lookup.doubt(config, field.surface, points_world)
    frontier = lookup.frontier(config, field.surface, points_world)
    cautious = jnp.minimum(_combine(config, nearest.sdf, network, frontier), doubt)
    # What has not been seen may hide a surface that is nearer than all that were.
    hidden = jnp.maximum(frontier, cautious - _HIDDEN_VOXELS * config.voxel_size)
    return jnp.minimum(cautious, hidden), scale


def _combine(config: Config, grid: jax.Array, network: jax.Array, frontier: jax.Array) -> jax.Array:
    if config.grid_share == 0:
        return network
    # No more than the distance itself: surfaces stay where the grid has them, thin ones too.
    limit = jnp.minimum(_LARGEST_CORRECTION_VOXELS * config.voxel_size, jnp.abs(grid))
    near = grid + (1 - config.grid_share) * jnp.clip(network - grid, -limit, limit)
    start, end = (share * config.distance_horizon for share in _FADE)
    far = jnp.clip((jnp.abs(grid) - start) / (end - start), 0, 1)
    start, end = (voxels * config.voxel_size for voxels in _FADE_UNSEEN_VOXELS)
    unseen = jnp.clip((-frontier - start) / (end - start), 0, 1)
    return near + jnp.maximum(far, unseen) * (network - near)
