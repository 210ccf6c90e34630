"""Checks of a cloud and its pose, with the messages that users see, and clouds of a fixed shape."""

from __future__ import annotations

import warnings
import zlib
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.rigid import is_rigid

_HASHED_EVERY = 64  # rows of a cloud per hashed row

LEAST_NOISE_M = 1e-4
"""Smaller noise would give a return a weight that float16 cannot hold."""


def check_shapes(cloud: Any, pose: Any) -> None:
    """Checks shapes only, which tracers have as well.

    Args:
        cloud: Expected (N, 3).
        pose: Expected (4, 4).

    Raises:
        ValueError: A shape is wrong.
    """
    _check_cloud_shape(cloud)
    _check_pose_shape(pose)


def check_pose(pose: Any, source: str = "") -> np.ndarray:
    """Checks that a pose is a rigid transform.

    Args:
        pose: (4, 4) T_world_sensor.
        source: Where the pose comes from, such as a file and a line. The message starts with it.

    Returns:
        (4, 4) float32, a copy of the pose.

    Raises:
        ValueError: The pose is misshapen, not finite or not rigid.
    """
    prefix = f"{source}: " if source else ""
    matrix = np.array(as_floats(f"{prefix}pose", pose))  # too large for float32: inf, refused below
    _check_pose_shape(matrix, prefix)
    if not np.isfinite(matrix).all():
        raise ValueError(
            f"{prefix}pose has values that are not finite, expected T_world_sensor: "
            f"{_printed(matrix)}"
        )
    if not is_rigid(matrix, np):
        raise ValueError(
            f"{prefix}pose is not rigid, expected a rotation and a translation of at most 100 km: "
            f"{_printed(matrix)}"
        )
    return matrix


def as_floats(name: str, values: Any) -> np.ndarray:
    """Converts an argument to float32. Masked elements become NaN.

    Args:
        name: What messages call the argument.
        values: Real numbers in an array, or what numpy makes one of.

    Returns:
        The array; not a copy if it is float32 already.

    Raises:
        ValueError: The values are no real numbers.
    """
    try:
        array = np.ma.asanyarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} is no array: {error}") from None
    if not (jnp.issubdtype(array.dtype, np.floating) or jnp.issubdtype(array.dtype, np.integer)):
        raise ValueError(f"{name} has dtype {array.dtype}, expected real numbers")
    with np.errstate(over="ignore"):
        floats = array.astype(np.float32, copy=False)
    return np.ma.filled(floats, np.nan) if np.ma.isMaskedArray(floats) else floats


def check_extras(robot: Any, noise: Any) -> tuple[Any, Any]:
    """Checks the optional arguments of an update, of tracers only their shapes.

    Args:
        robot: Centers (K, 3) m and radii (K,) m of the robot's spheres, world frame, or None.
        noise: (a, b) of the standard deviation a + b r^2 at range r, m and 1/m, or None.

    Returns:
        The arguments as float32 arrays, or None.

    Raises:
        ValueError: A shape is wrong, or a value is not finite or out of range.
    """
    if robot is not None:
        try:
            centers, radii = robot
        except (TypeError, ValueError):
            raise ValueError(f"robot is {robot!r}, expected (centers, radii)") from None
        shapes = np.shape(centers), np.shape(radii)
        if len(shapes[0]) != 2 or shapes != ((shapes[0][0], 3), (shapes[0][0],)):
            raise ValueError(
                f"robot has centers of shape {shapes[0]} and radii of shape {shapes[1]}, "
                "expected (K, 3) and (K,)"
            )
        _check_values("robot centers", centers, -np.inf)
        _check_values("robot radii", radii, 0)
        robot = (jnp.asarray(centers, jnp.float32), jnp.asarray(radii, jnp.float32))
    if noise is not None:
        # Tracers in a tuple have no shape of their own.
        shape = (len(noise),) if isinstance(noise, tuple | list) else np.shape(noise)
        if shape != (2,):
            raise ValueError(f"noise is {noise!r}, expected two numbers (a, b)")
        floor, growth = noise
        _check_values("noise a", floor, LEAST_NOISE_M)
        _check_values("noise b", growth, 0)
        noise = jnp.stack([jnp.asarray(floor, jnp.float32), jnp.asarray(growth, jnp.float32)])
    return robot, noise


def extras_are_valid(
    robot: tuple[jax.Array, jax.Array] | None, noise: jax.Array | None
) -> jax.Array:
    """Returns whether traced `robot` and `noise` have values that `check_extras` accepts, ()."""
    valid = jnp.asarray(True)
    if robot is not None:
        centers, radii = robot
        valid &= jnp.isfinite(centers).all() & (jnp.isfinite(radii) & (radii >= 0)).all()
    if noise is not None:
        least = jnp.asarray([LEAST_NOISE_M, 0.0], jnp.float32)
        valid &= (jnp.isfinite(noise) & (noise >= least)).all()
    return valid


def _check_values(name: str, values: Any, least: float) -> None:
    if isinstance(values, jax.core.Tracer):
        return
    array = as_floats(name, values)
    if not (np.isfinite(array).all() and (array >= np.float32(least)).all()):
        expected = "finite values" if least == -np.inf else f"finite values >= {least:.3g}"
        raise ValueError(
            f"{name} has values from {array.min()} to {array.max()}, expected {expected}"
        )


def finite_rows(cloud: Any) -> np.ndarray:
    """Finds the returns of a cloud.

    Args:
        cloud: (N, 3) m; a row with a NaN or inf is no return.

    Returns:
        (N,) bool, at least one of them True.

    Raises:
        ValueError: The cloud is misshapen or has no return.
    """
    _check_cloud_shape(cloud)
    x, y, z = np.asarray(cloud).T  # one column at a time is many times faster than all(axis=1)
    finite = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    if not finite.any():
        raise ValueError(
            f"cloud has no finite row among its {len(finite)}, expected at least one return"
        )
    return finite


def prepare(cloud: Any, pose: Any, capacity: int) -> tuple[np.ndarray, np.ndarray]:
    """Checks the values of a cloud and its pose, and brings the cloud to a fixed shape.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns.
        pose: (4, 4) T_world_sensor.
        capacity: Rows of the result. Smaller clouds are padded with NaN; larger ones are drawn from
            at random.

    Returns:
        The cloud (capacity, 3) and the pose, float32.

    Raises:
        ValueError: A shape is wrong, the pose is not finite or not rigid, or the cloud has no
            finite row.
    """
    cloud, pose = as_floats("cloud", cloud), check_pose(pose)
    finite = finite_rows(cloud)
    padded = np.empty((capacity, 3), np.float32)
    count = len(cloud)
    if count <= capacity:
        padded[:count] = cloud
    else:
        # The draw must be a function of the arguments, and differ from cloud to cloud.
        seed = zlib.crc32(cloud[::_HASHED_EVERY].tobytes(), zlib.crc32(pose.tobytes()))
        rows = _draw(finite, seed, capacity)
        count = len(rows)
        np.take(cloud, rows, axis=0, out=padded[:count], mode="clip")  # "raise" copies twice
    padded[count:] = np.nan
    return padded, pose


def warn_out_of_range(
    cloud: np.ndarray, min_range: float, max_range: float, min_share: float
) -> None:
    """Warns of a cloud with almost no return in range, and names the likely unit.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN are no returns.
        min_range: Least range of a return that counts, m.
        max_range: Largest range of a return that counts, m.
        min_share: Least share of the returns that must be in range.
    """
    x, y, z = cloud.T.astype(np.float64)  # a finite row must not overflow
    square = x * x + y * y + z * z
    square = square[np.isfinite(square)]
    usable = np.count_nonzero((square >= min_range**2) & (square <= max_range**2))
    if usable >= min_share * len(square):
        return
    middle = float(np.sqrt(np.median(square)))
    unit = "millimeters" if min_range <= middle / 1000 <= max_range else "m"
    warnings.warn(
        f"cloud has {usable} of {len(square)} returns between min_range, {min_range:g} m, and "
        f"max_range, {max_range:g} m; the median range is {middle:.3g} m. The map ignores it. "
        + (
            "It looks like millimeters, expected m"
            if unit != "m"
            else f"Its unit must be m; Config.min_in_range is {min_share:g}"
        ),
        stacklevel=3,
    )


def _check_cloud_shape(cloud: Any) -> None:
    if np.ndim(cloud) != 2 or np.shape(cloud)[1] != 3:
        raise ValueError(f"cloud has shape {np.shape(cloud)}, expected (N, 3)")


def _check_pose_shape(pose: Any, prefix: str = "") -> None:
    if np.shape(pose) != (4, 4):
        raise ValueError(f"{prefix}pose has shape {np.shape(pose)}, expected (4, 4)")


def _printed(matrix: np.ndarray) -> str:
    return np.array2string(matrix, precision=4, separator=", ")


def _draw(finite: np.ndarray, seed: int, capacity: int) -> np.ndarray:
    """Draws the indices of at most `capacity` finite rows."""
    rows = np.flatnonzero(finite)
    dropped = len(rows) - capacity
    if dropped <= 0:
        return rows
    rng = np.random.default_rng(seed)
    # Draws with repetition until enough rows are distinct: the rows to keep or those to drop,
    # whichever are fewer. A permutation would touch every row of a large cloud.
    fewer = min(capacity, dropped)
    chosen = np.zeros(len(rows), bool)
    while missing := fewer - np.count_nonzero(chosen):
        chosen[rng.integers(len(rows), size=missing)] = True
    return rows[np.flatnonzero(chosen if fewer == capacity else ~chosen)]
