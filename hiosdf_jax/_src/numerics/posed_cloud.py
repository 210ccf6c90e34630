"""Checks of a cloud and its pose, with the messages that users see, and clouds of a fixed shape."""

from __future__ import annotations

import warnings
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.intake import as_array, as_floats, is_traced
from hiosdf_jax._src.numerics.rigid import FARTHEST_M, TOLERANCE, is_rigid

_HASHED_EVERY = 64  # rows of a cloud per hashed row
_TRIED_ROWS = 2000  # of a cloud that almost certainly has returns inside the bounds

LEAST_NOISE_M = 1e-4
"""Smaller noise would give a return a weight that float16 cannot hold."""

LARGEST_RADIUS_M = 5.0
"""Larger spheres of a robot are in millimeters, or a mistake that would empty the map."""


def as_traced(cloud: Any, pose: Any) -> tuple[jax.Array, jax.Array]:
    """Checks types and shapes only, which tracers have as well.

    Args:
        cloud: Expected (N, 3).
        pose: Expected (4, 4).

    Returns:
        Both as arrays of JAX, float32.

    Raises:
        ValueError: A type or a shape is wrong.
    """
    cloud, pose = as_array("cloud", cloud), as_array("pose", pose)
    _check_cloud_shape(cloud)
    _check_pose_shape(pose)
    return jnp.asarray(cloud), jnp.asarray(pose)


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
        raise ValueError(f"{prefix}pose {_pose_fault(matrix)}: {_printed(matrix)}")
    return matrix


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
        if centers.ndim != 2 or (centers.shape, radii.shape) != ((len(radii), 3), (len(radii),)):
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
        _check_values("noise a", noise[0], LEAST_NOISE_M)
        _check_values("noise b", noise[1], 0)
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
        valid &= (jnp.isfinite(noise) & (noise >= least)).all()
    return valid


def _check_values(name: str, values: Any, least: float, most_m: float = np.inf) -> None:
    if is_traced(values):
        return
    array = np.asarray(values)
    came = f"{name} has values from {array.min()} to {array.max()}, expected"
    if not (np.isfinite(array).all() and (array >= np.float32(least)).all()):
        expected = "finite values" if least == -np.inf else f"finite values >= {least:.3g}"
        raise ValueError(f"{came} {expected}")
    if (array > most_m).any():
        raise ValueError(f"{came} meters, at most {most_m:g}; are they in millimeters?")


def checked_cloud(cloud: Any) -> np.ndarray:
    """Checks a cloud, and returns it as (N, 3) float32; masked elements are NaN.

    Raises:
        ValueError: It is no array of real numbers, or misshapen.
    """
    floats = as_floats("cloud", cloud)
    _check_cloud_shape(floats)
    return floats


def finite_rows(cloud: Any) -> np.ndarray:
    """Finds the returns of a cloud.

    Args:
        cloud: (N, 3) m; a row with a NaN or inf is no return.

    Returns:
        (N,) bool, at least one of them True.

    Raises:
        ValueError: The cloud is misshapen or has no return.
    """
    x, y, z = checked_cloud(cloud).T  # one column at a time is many times faster than all(axis=1)
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
        capacity: Rows of the result, see `pad_rows`.

    Returns:
        The cloud (capacity, 3) and the pose, float32.

    Raises:
        ValueError: A shape is wrong, the pose is not finite or not rigid, or the cloud has no
            finite row.
    """
    cloud, pose = checked_cloud(cloud), check_pose(pose)
    return pad_rows(cloud, capacity, pose), pose


def pad_rows(cloud: np.ndarray, capacity: int, pose: np.ndarray | None = None) -> np.ndarray:
    """Brings a cloud to a fixed shape.

    Args:
        cloud: (N, 3) float32, m; rows with a NaN or inf are no returns.
        capacity: Rows of the result. Smaller clouds are padded with NaN; larger ones are drawn from
            at random.
        pose: (4, 4) float32; other poses draw other rows.

    Returns:
        (capacity, 3) float32.

    Raises:
        ValueError: The shape is wrong, or the cloud has no finite row.
    """
    finite = finite_rows(cloud)
    padded = np.empty((capacity, 3), np.float32)
    count = len(cloud)
    if count <= capacity:
        padded[:count] = cloud
    else:
        # The draw must be a function of the arguments, and differ from cloud to cloud.
        start = 0 if pose is None else zlib.crc32(pose.tobytes())
        seed = zlib.crc32(cloud[::_HASHED_EVERY].tobytes(), start)
        rows = _draw(finite, seed, capacity)
        count = len(rows)
        np.take(cloud, rows, axis=0, out=padded[:count], mode="clip")  # "raise" copies twice
    padded[count:] = np.nan
    return padded


def warn_out_of_range(
    cloud: np.ndarray, min_range: float, max_range: float, min_share: float
) -> bool:
    """Warns of a cloud with almost no return in range, and names the likely unit.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN are no returns.
        min_range: Least range of a return that counts, m.
        max_range: Largest range of a return that counts, m.
        min_share: Least share of the returns that must be in range.

    Returns:
        Whether it warned.
    """
    square = _square_ranges(cloud)
    square = square[np.isfinite(square)]
    usable = np.count_nonzero((square >= min_range**2) & (square <= max_range**2))
    if usable >= min_share * len(square):
        return False
    middle = float(np.sqrt(np.median(square)))
    units = {"centimeters": 100, "millimeters": 1000}
    likely = [unit for unit, per_m in units.items() if min_range <= middle / per_m <= max_range]
    warnings.warn(
        f"cloud has {usable} of {len(square)} returns between min_range, {min_range:g} m, and "
        f"max_range, {max_range:g} m; the median range is {middle:.3g} m. The map ignores it. "
        + (
            f"It looks like {' or '.join(likely)}, expected m"
            if likely
            else f"Its unit must be m; Config.min_in_range is {min_share:g}"
        ),
        stacklevel=3,
    )
    return True


def warn_outside(
    cloud: np.ndarray,
    pose: np.ndarray,
    bounds: Any,
    min_range: float,
    max_range: float,
    min_share: float,
) -> None:
    """Warns of a cloud with almost no return inside the bounds, among those in range.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN are no returns.
        pose: (4, 4) T_world_sensor.
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame.
        min_range: Least range of a return that counts, m.
        max_range: Largest range of a return that counts, m.
        min_share: Least share of the returns in range that must lie inside.
    """

    def count(rows: np.ndarray) -> tuple[int, int]:
        """Counts the returns in range, and those of them inside."""
        square = _square_ranges(rows)
        inside = in_range = (square >= min_range**2) & (square <= max_range**2)
        with np.errstate(over="ignore", invalid="ignore"):  # rows that are not in range
            for k in range(3):
                world = rows @ pose[k, :3] + pose[k, 3]
                inside = inside & (world >= bounds[0][k]) & (world <= bounds[1][k])
        return int(np.count_nonzero(in_range)), int(np.count_nonzero(inside))

    some_in_range, some_inside = count(cloud[:: -(-len(cloud) // _TRIED_ROWS)])
    if some_inside and some_inside >= min_share * some_in_range:
        return
    in_range, inside = count(cloud)
    if inside >= min_share * in_range:
        return
    # Without numbers of this cloud: Python shows an equal message once, and not at 30 Hz.
    warnings.warn(
        f"cloud has less than {100 * min_share:g} % of its returns in range inside the bounds, "
        f"{bounds}: is the pose wrong, the cloud in the world frame, or the box too small? Its "
        "rays clear space, but those returns leave no surface. Config.min_in_range=0 turns this "
        "warning off",
        stacklevel=3,
    )


def _square_ranges(cloud: np.ndarray) -> np.ndarray:
    x, y, z = cloud.T.astype(np.float64)  # a finite row must not overflow
    return x * x + y * y + z * z


def _check_cloud_shape(cloud: Any) -> None:
    if np.ndim(cloud) != 2 or np.shape(cloud)[1] != 3:
        raise ValueError(f"cloud has shape {np.shape(cloud)}, expected (N, 3)")


def _check_pose_shape(pose: Any, prefix: str = "") -> None:
    if np.shape(pose) != (4, 4):
        raise ValueError(f"{prefix}pose has shape {np.shape(pose)}, expected (4, 4)")


def _pose_fault(pose: np.ndarray) -> str:
    """Says in words why a finite pose is refused."""
    rotation, position = pose[:3, :3].astype(np.float64), pose[:3, 3].astype(np.float64)
    gram = rotation.T @ rotation
    lengths = np.sqrt(np.diag(gram))
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        hint = "; is it transposed?" if is_rigid(pose.T, np) else ""
        return f"is not rigid: its last row is {_printed(pose[3])}, expected [0, 0, 0, 1]{hint}"
    if np.abs(lengths**2 - 1).max() > TOLERANCE:
        length = f"{lengths[0]:.4g}" if np.ptp(lengths) <= TOLERANCE else _printed(lengths)
        return f"is not rigid: its columns have length {length}, expected 1"
    if np.linalg.det(rotation) < 0:
        return "is not rigid: its determinant is -1, expected 1; it mirrors the cloud"
    if np.abs(position).max() > FARTHEST_M:
        kilometers = np.linalg.norm(position) / 1000
        return f"is {kilometers:.4g} km from the origin, expected at most {FARTHEST_M / 1000:g} km"
    return "is not rigid: its columns are not perpendicular, expected a rotation"


def _printed(matrix: np.ndarray) -> str:
    return " ".join(np.array2string(matrix, precision=4, separator=", ").split())  # in one line


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
