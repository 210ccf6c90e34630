"""The optional arguments of an update: the robot's spheres, and the sensor's noise."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.intake import as_array, check_pose, cloud_and_returns, is_traced
from hiosdf_jax._src.numerics.modes import plain, varying_like
from hiosdf_jax._src.numerics.vectors import length, split

# Noise moves returns off the robot. They count as on it up to this distance from its spheres, m, or
# this multiple of the standard deviation of their range, whichever is larger.
_MARGIN_M = 0.03
_MARGIN_SIGMAS = 3.0

LEAST_NOISE_M = 1e-4
"""Smaller noise would give a return a weight that float16 cannot hold."""

LARGEST_NOISE = 1.0
"""Larger noise, m and 1/m, is that of a sensor in millimeters, or no sensor's."""

LARGEST_RADIUS_M = 5.0
"""Larger spheres of a robot are in millimeters, or a mistake that would empty the map."""


def check_extras(robot: Any, noise: Any) -> tuple[Any, Any]:
    """Checks the optional arguments of an update, of tracers only their shapes.

    Args:
        robot: Centers (K, 3) m and radii (K,) m of the robot's spheres, world frame, or None.
        noise: (a, b) of the standard deviation a + b r^2 at range r, m and 1/m, or None.

    Returns:
        The arguments as float32 arrays, or None. A robot of no spheres is None.

    Raises:
        ValueError: A shape is wrong, or a value is not finite or out of range.
    """
    if robot is not None:
        try:
            centers, radii = robot
        except (TypeError, ValueError):
            raise ValueError(f"robot is {robot!r}, expected (centers, radii)") from None
        centers, radii = as_array("robot centers", centers), as_array("robot radii", radii)
        if radii.ndim != 1 or centers.shape != (len(radii), 3):
            raise ValueError(
                f"robot has centers of shape {centers.shape} and radii of shape {radii.shape}, "
                "expected (K, 3) and (K,)"
            )
        robot = None
        if len(radii):
            _check_values("robot centers", centers, -np.inf)
            _check_values("robot radii", radii, 0, LARGEST_RADIUS_M)
            robot = (jnp.asarray(centers), jnp.asarray(radii))
    if noise is not None:
        given = noise
        noise = as_array("noise", given)
        if noise.shape != (2,):
            raise ValueError(f"noise is {given!r}, expected two numbers (a, b)")
        _check_values("noise a", noise[0], LEAST_NOISE_M, LARGEST_NOISE)
        _check_values("noise b", noise[1], 0, LARGEST_NOISE, "1/m")
        noise = jnp.asarray(noise)
    return robot, noise


def extras_are_valid(
    robot: tuple[jax.Array, jax.Array] | None, noise: jax.Array | None
) -> jax.Array:
    """Returns whether traced `robot` and `noise` have values that `check_extras` accepts, ()."""
    valid = jnp.asarray(True)
    if robot is not None:
        centers, radii = robot
        valid &= jnp.isfinite(centers).all()
        valid &= ((radii >= 0) & (radii <= LARGEST_RADIUS_M)).all()  # False for NaN
    if noise is not None:
        least = jnp.asarray([LEAST_NOISE_M, 0.0], jnp.float32)
        valid &= ((noise >= least) & (noise <= LARGEST_NOISE)).all()  # False for NaN
    return valid


def is_on_robot(
    points_world: jax.Array, sigma: jax.Array, centers_world: jax.Array, radii: jax.Array
) -> jax.Array:
    """Returns a mask of the returns on the robot.

    Args:
        points_world: The returns, (N, 3) m.
        sigma: Standard deviations of their ranges, (N,) m.
        centers_world: Centers of the robot's spheres, (K, 3) m.
        radii: Their radii, (K,) m.

    Returns:
        (N,) bool.
    """
    margin = jnp.maximum(_MARGIN_M, _MARGIN_SIGMAS * sigma)

    def add(found: jax.Array, sphere: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        center, radius = sphere
        distance = length(split(points_world - center))
        return found | (distance <= radius + margin), None

    start = varying_like(jnp.zeros(margin.shape, bool), points_world, sigma, centers_world, radii)
    return jax.lax.scan(add, start, (centers_world, radii))[0]


@plain
def leave_out_robot(cloud: jax.Array, pose: jax.Array, robot: Any, noise: Any) -> jax.Array:
    """Sets the rows of a cloud on the robot to NaN; all rows if the spheres are invalid.

    Args:
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.
        robot: Centers (K, 3) m, world frame, and radii (K,) m.
        noise: (a, b) of the standard deviation a + b r^2 at range r, m and 1/m.

    Returns:
        (N, 3).
    """
    offsets_world = jnp.sum(cloud[:, None, :] * pose[:3, :3], axis=-1)
    sigma = noise[0] + noise[1] * jnp.sum(cloud**2, axis=-1)
    left_out = is_on_robot(pose[:3, 3] + offsets_world, sigma, *robot)
    left_out |= ~extras_are_valid(robot, None)
    return jnp.where(left_out[:, None], jnp.nan, cloud)


def leave_out_robot_on_host(
    cloud: Any, pose: Any, robot: Any, noise: Any
) -> tuple[np.ndarray, bool]:
    """Sets the rows of a cloud on the robot to NaN, without the device.

    Args:
        cloud: As for `leave_out_robot`.
        pose: As for `leave_out_robot`.
        robot: As for `leave_out_robot`.
        noise: As for `leave_out_robot`.

    Returns:
        The cloud (N, 3) float32, and whether all returns are on the robot. Then the cloud is
        returned as it is, since a cloud needs a return.

    Raises:
        ValueError: The cloud is misshapen or has no return, or the pose is not finite or not rigid.
    """
    floats, finite = cloud_and_returns(cloud)
    matrix = check_pose(pose)
    radii = np.asarray(robot[1])
    centers = (np.asarray(robot[0]) - matrix[:3, 3]) @ matrix[:3, :3]
    squares = np.einsum("ij,ij->i", floats, floats)
    a, b = np.asarray(noise)
    margin = np.maximum(_MARGIN_M, _MARGIN_SIGMAS * (a + b * squares))
    reach = (np.linalg.norm(centers, axis=1) + radii).max()
    near = np.flatnonzero(squares <= (reach + margin) ** 2)  # most returns are beyond the robot
    left_out = np.zeros(len(near), bool)
    for center, radius in zip(centers, radii, strict=True):
        offsets = floats[near] - center
        left_out |= np.einsum("ij,ij->i", offsets, offsets) <= (radius + margin[near]) ** 2
    result = floats.copy()
    result[near[left_out]] = np.nan
    only_robot = np.count_nonzero(left_out) == np.count_nonzero(finite)
    return (floats, True) if only_robot else (result, False)


def _check_values(
    name: str, values: Any, least: float, most: float = np.inf, unit: str = "meters"
) -> None:
    if is_traced(values):
        return
    array = np.asarray(values)
    came = f"{name} has values from {array.min()} to {array.max()}, expected"
    if not (np.isfinite(array).all() and (array >= np.float32(least)).all()):
        expected = "finite values" if least == -np.inf else f"finite values >= {least:.3g}"
        raise ValueError(f"{came} {expected}")
    if (array > most).any():
        raise ValueError(f"{came} {unit}, at most {most:g}; are they in millimeters?")
