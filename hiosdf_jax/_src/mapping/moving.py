"""The rows of a cloud that are on moving or new things."""

from __future__ import annotations

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.change.novelty import compare_cloud
from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.numerics.posed_cloud import as_floats, check_extras, check_pose, check_shapes
from hiosdf_jax._src.state import MapState, check_map


def moving_rows(
    state: MapState, cloud: Any, pose: Any, *, noise: tuple[Any, Any] | None = None
) -> jax.Array:
    """Finds the returns of a cloud that are on moving or new things: in space that was seen free.

    Ask before the cloud is fused, with the map that `update` takes.

    Args:
        state: The map before the cloud.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns.
        pose: (4, 4) T_world_sensor, rigid.
        noise: As for `update`.

    Returns:
        (N,) bool; False for rows that are no returns.

    Raises:
        ValueError: An argument has a wrong type or shape. Outside jit also: the pose is not finite
            or not rigid, or a value of `noise` is out of range.

    Example:
        >>> moving = hio.moving_rows(state, cloud, pose)
        >>> state = hio.update(state, cloud, pose)
    """
    check_map(state)
    _, sigma = check_extras(None, noise)
    check_shapes(cloud, pose)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((state, cloud, pose))):
        return _moving_rows(state, jnp.asarray(cloud), jnp.asarray(pose), sigma)
    floats = as_floats("cloud", cloud)
    # Padded to a multiple of one size, so that clouds of a stream share their compilation.
    rows, step = np.shape(cloud)[0], state.config.max_points
    padded = np.full((-(-max(rows, 1) // step) * step, 3), np.nan, np.float32)
    padded[:rows] = floats
    return _moving_rows_jit(state, padded, check_pose(pose), sigma)[:rows]


def _moving_rows(
    state: MapState, cloud: jax.Array, pose: jax.Array, noise: jax.Array | None
) -> jax.Array:
    cloud, pose = cloud.astype(jnp.float32), pose.astype(jnp.float32)
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    rays = place_cloud(state.config, cloud, finite, pose, noise)
    found = compare_cloud(state.config, state.grid, rays, state.updates)
    return found.novel | found.near_new


_moving_rows_jit = jax.jit(_moving_rows)
