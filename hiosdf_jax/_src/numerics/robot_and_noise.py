"""Checks of the optional arguments of an update: the robot's spheres, the sensor's noise."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.intake import as_array, is_traced

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
