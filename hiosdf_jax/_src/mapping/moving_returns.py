"""The rows of a cloud that are on moving or new things."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.stages import CHECKS, begin, run_stages
from hiosdf_jax._src.numerics.intake import as_traced, check_pose, checked_cloud, is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.robot_and_noise import check_extras
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import MapState


def moving_rows(
    state: MapState,
    cloud: Any,
    pose: Any,
    *,
    robot: tuple[Any, Any] | None = None,
    noise: tuple[Any, Any] | None = None,
) -> jax.Array:
    """Finds the returns of a cloud that are on moving or new things.

    Ask before the cloud is fused, with the map and the arguments that `update` takes. Marked are

    - returns in space that was seen free, away from all surfaces; `Report.points_moving` counts
      these alone
    - returns on or next to a surface that is itself new: it appeared in the last few scans.

    Returns that `update` leaves out are not marked: those on the robot, stray ones, and those out
    of range or outside the bounds. In a static scene a few returns can be marked too, on things
    that come into view, such as an edge or a thin part that earlier rays have passed.

    Args:
        state: The map before the cloud.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        pose: (4, 4) T_world_sensor, rigid.
        robot: As for `update`.
        noise: As for `update`.

    Returns:
        (N,) bool; False for rows that are not returns.

    Raises:
        ValueError: An argument has a wrong type or shape. Outside jit also: the pose is not finite
            or not rigid, or a value of `robot` or `noise` is out of range.

    Example:
        >>> moving = hio.moving_rows(state, cloud, pose)
        >>> state = hio.update(state, cloud, pose)
    """
    check_map(state, batched="jax.vmap(hio.moving_rows)(maps, clouds, poses)")
    extras = check_extras(robot, noise)
    if is_traced(*jax.tree.leaves((state, extras)), cloud, pose):
        return _moving_rows(state, *as_traced(cloud, pose), *extras)
    floats, matrix = checked_cloud(cloud), check_pose(pose)
    # Padded to a multiple of one size, so that clouds of a stream share their compilation.
    rows, step = len(floats), state.config.max_points
    padded = np.full((-(-max(rows, 1) // step) * step, 3), np.nan, np.float32)
    padded[:rows] = floats
    return _moving_rows_jit(state, padded, matrix, *extras)[:rows]


@plain
def _moving_rows(
    state: MapState,
    cloud: jax.Array,
    pose: jax.Array,
    robot: tuple[jax.Array, jax.Array] | None,
    noise: jax.Array | None,
) -> jax.Array:
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    checked = run_stages(begin(state, cloud, finite, pose, robot, noise), CHECKS)
    return checked.novelty.novel | checked.novelty.near_new


_moving_rows_jit = jax.jit(_moving_rows)
