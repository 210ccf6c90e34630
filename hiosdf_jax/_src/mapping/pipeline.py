"""Updates a map: checks a cloud, brings it to a fixed number of rows, runs the stages."""

from __future__ import annotations

import math
import warnings
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.mapping.stages import (
    CHECKS,
    FUSION,
    begin,
    is_accepted,
    refuse,
    run_stages,
)
from hiosdf_jax._src.numerics.collecting import collector_paused
from hiosdf_jax._src.numerics.intake import (
    as_traced,
    check_pose,
    checked_cloud,
    cloud_and_returns,
    is_traced,
)
from hiosdf_jax._src.numerics.modes import cond, plain
from hiosdf_jax._src.numerics.robot_and_noise import check_extras
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import MapState

_HASHED_EVERY = 64  # rows of a cloud per hashed row
_SAMPLED_ROWS = 500  # of a cloud; all rows are counted where the sample is not clear
_CLEAR_FACTOR = 2  # a sample is clear from this many times the least share on
# Fractional parts of multiples of the golden ratio: evenly spread, not periodic.
_SAMPLED_AT = np.arange(_SAMPLED_ROWS) * (math.sqrt(1.25) - 0.5) % 1

_NO_FLAG = np.uint32(0)  # inside jit; outside, the number must be on the device already


def update(
    state: MapState,
    cloud: Any,
    pose: Any,
    *,
    donate: bool = False,
    robot: tuple[Any, Any] | None = None,
    noise: tuple[Any, Any] | None = None,
) -> MapState:
    """Fuses one posed point cloud into the map.

    Pure: the given state stays valid unless it is donated. Outside jit, the arguments are checked,
    the cloud is padded or drawn to `config.max_points` rows, and one compiled function runs. Inside
    `jit`, `lax.scan` or `vmap` the shapes are used as they are, and problems are reported by
    `state.report.flags`. Under `vmap`, stages that choose between two windows compute both.

    Args:
        state: The map so far.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        pose: (4, 4) T_world_sensor, rigid.
        donate: Reuse the memory of `state` for the new map. This is faster on a GPU, not on a CPU.
            The old map, its `report` and a `BackgroundMapper` that began with it become invalid.
            Results of `snapshot`, `bake` and `grow` stay valid. A ValueError donates nothing.
            Inside jit this has no effect: donate the arguments of the outer function instead.
        robot: Centers (K, 3) m and radii (K,) m of spheres that cover the robot, for instance from
            `planning.place_spheres`. The centers are in the world frame, at the time of the cloud.
            Returns on them leave no surface and clear no space: those within 3 cm, or three
            standard deviations of their range if that is more. Surfaces that were mapped inside
            the spheres are removed, and the voxels that held them count as free; unseen space
            stays unseen.
        noise: (a, b) of the standard deviation a + b r^2 of this cloud's returns at range r, m and
            1/m, for sensors of different quality. By default it is `config.range_noise`. Where it
            is given and exceeds a fifth of a voxel, ranges are averaged over neighboring rays.

    Returns:
        The new map.

    Raises:
        ValueError: A shape is wrong. Outside jit also: the pose is not finite, not rigid or farther
            than 100 km from the origin, the cloud has no finite row, or a value of `robot` or
            `noise` is out of range, such as a radius above 5 m.

    Warns:
        UserWarning: Outside jit, if almost no return is in range, which refuses the cloud, or
            almost none of those in range lies in the bounds. A cloud that is refused because it
            contradicts the map causes no warning, since that would wait for the device: read
            `state.report.update_flags`, or whether `state.updates` has grown.

    Example:
        >>> for cloud, pose in stream:
        ...     state = hio.update(state, cloud, pose)
    """
    check_map(state, batched="jax.vmap(hio.update)(maps, clouds, poses)")
    extras = check_extras(robot, noise)
    if is_traced(*jax.tree.leaves((state, extras)), cloud, pose):
        return run_update(state, *as_traced(cloud, pose), extras)
    config = state.config
    cloud, pose = check_and_pad(cloud, pose, config.max_points)
    limits = (config.min_range, config.max_range, config.min_in_range)
    if not warn_out_of_range(cloud, *limits):
        warn_outside(cloud, pose, config.bounds, *limits)
    cloud, pose, no_flag = jax.device_put((cloud, pose, _NO_FLAG))
    return run_update(state, cloud, pose, extras, no_flag, donate)


def run_update(
    state: MapState,
    cloud: jax.Array,
    pose: jax.Array,
    extras: Any,
    flags_so_far: jax.Array | np.uint32 = _NO_FLAG,
    donate: bool = False,
) -> MapState:
    """Runs the compiled update, the same one for `update` and for tracking.

    Inside jit it is a nested call of the same compiled function, traced once per shape.

    Args:
        state: The map so far.
        cloud: (N, 3) float32. Outside jit checked, padded, and on the device.
        pose: (4, 4) float32, likewise.
        extras: `robot` and `noise`, checked.
        flags_so_far: Flags of `Flag` that are raised before the checks, () uint32.
        donate: As for `update`.

    Returns:
        The new map.
    """
    compiled = _update_donating if donate else _update_jit
    with collector_paused():
        return compiled(state, cloud, pose, *extras, flags_so_far)


def pad_cloud(config: Config, cloud: Any, pose: Any = None) -> np.ndarray:
    """Brings a cloud to `config.max_points` rows, as `update` does outside jit.

    In a loop inside `jit`, clouds of other sizes would compile `update` again. Pad them first.

    Args:
        config: The map's configuration.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored. Not inside jit.
        pose: The cloud's pose, (4, 4). It matters for clouds of more than `max_points` rows: with
            it, the same rows are drawn as by `update`.

    Returns:
        (max_points, 3) float32: the cloud and rows of NaN, or rows of it, drawn at random.

    Raises:
        ValueError: An argument has a wrong type or shape, or the cloud has no finite row.

    Example:
        >>> clouds = jnp.stack([hio.pad_cloud(config, cloud) for cloud in clouds])
        >>> step = lambda state, frame: (hio.update(state, *frame), None)
        >>> state, _ = jax.lax.scan(step, state, (clouds, poses))
    """
    if not isinstance(config, Config):
        raise ValueError(f"config is {type(config).__name__}, expected a hiosdf_jax.Config")
    if is_traced(cloud):
        raise ValueError("cloud is traced, expected concrete numbers: call pad_cloud outside jit")
    pose = None if pose is None else check_pose(pose)
    return _pad_rows(*cloud_and_returns(cloud), config.max_points, pose)


def check_and_pad(cloud: Any, pose: Any, capacity: int) -> tuple[np.ndarray, np.ndarray]:
    """Checks the values of a cloud and its pose, and brings the cloud to a fixed shape.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        pose: (4, 4) T_world_sensor.
        capacity: Rows of the result, see `_pad_rows`.

    Returns:
        The cloud (capacity, 3) and the pose, float32.

    Raises:
        ValueError: A shape is wrong, the pose is not finite or not rigid, or the cloud has no
            finite row.
    """
    cloud, pose = checked_cloud(cloud), check_pose(pose)
    cloud, finite = cloud_and_returns(cloud)
    return _pad_rows(cloud, finite, capacity, pose), pose


def _pad_rows(
    cloud: np.ndarray, finite: np.ndarray, capacity: int, pose: np.ndarray | None
) -> np.ndarray:
    """Brings a cloud to a fixed shape.

    Args:
        cloud: (N, 3) float32, m.
        finite: A mask of its returns, (N,) bool.
        capacity: Rows of the result. Smaller clouds are padded with NaN; larger ones are drawn from
            at random.
        pose: (4, 4) float32; other poses draw other rows.

    Returns:
        (capacity, 3) float32.
    """
    padded = np.empty((capacity, 3), np.float32)
    count = len(cloud)
    if count <= capacity:
        padded[:count] = cloud
    else:
        # Same arguments, same rows; another cloud, other rows.
        start = 0 if pose is None else zlib.crc32(pose.tobytes())
        seed = zlib.crc32(cloud[::_HASHED_EVERY].tobytes(), start)
        rows = _draw(finite, seed, capacity)
        count = len(rows)
        np.take(cloud, rows, axis=0, out=padded[:count], mode="clip")  # "raise" copies twice
    padded[count:] = np.nan
    return padded


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


def warn_out_of_range(
    cloud: np.ndarray, min_range: float, max_range: float, min_share: float
) -> bool:
    """Warns of a cloud with almost no return in range, and names the likely unit.

    Args:
        cloud: (N, 3) m, sensor frame; rows with a NaN are ignored.
        min_range: Least range of a return that counts, m.
        max_range: Largest range of a return that counts, m.
        min_share: Least share of the returns that must be in range.

    Returns:
        Whether it warned.
    """

    def count(rows: np.ndarray) -> tuple[int, np.ndarray]:
        """Counts the returns in range, and computes the squared ranges of all."""
        square = _square_ranges(rows)
        square = square[np.isfinite(square)]
        usable = np.count_nonzero((square >= min_range**2) & (square <= max_range**2))
        return int(usable), square

    usable, square = count(_sample_rows(cloud))
    if _is_clear(usable, len(square), min_share):
        return False
    usable, square = count(cloud)
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
        cloud: (N, 3) m, sensor frame; rows with a NaN are ignored.
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

    in_range, inside = count(_sample_rows(cloud))
    if _is_clear(inside, in_range, min_share):
        return
    in_range, inside = count(cloud)
    if inside >= min_share * in_range:
        return
    # The message has no number of this cloud, so that Python shows it once, and not at 30 Hz.
    warnings.warn(
        f"cloud has less than {100 * min_share:g} % of its returns in range inside the bounds, "
        f"{bounds}: is the pose wrong, the cloud in the world frame, or the box too small? Its "
        "rays clear space, but those returns leave no surface. Config.min_in_range=0 turns this "
        "warning off",
        stacklevel=3,
    )


def _sample_rows(cloud: np.ndarray) -> np.ndarray:
    """Returns `_SAMPLED_ROWS` rows of a larger cloud."""
    if len(cloud) <= _SAMPLED_ROWS:
        return cloud
    return cloud[(_SAMPLED_AT * len(cloud)).astype(np.int64)]


def _is_clear(usable: int, returns: int, min_share: float) -> bool:
    """Returns whether a sample of rows has clearly more than the least share of usable returns.

    A sample of a padded cloud may have few returns. Then the share is that of the sampled rows.
    """
    return usable >= _CLEAR_FACTOR * min_share * max(returns, _SAMPLED_ROWS)


def _square_ranges(cloud: np.ndarray) -> np.ndarray:
    x, y, z = cloud.T.astype(np.float64)  # a finite row must not overflow
    return x * x + y * y + z * z


@plain
def _update(
    state: MapState,
    cloud: jax.Array,
    pose: jax.Array,
    robot: tuple[jax.Array, jax.Array] | None,
    noise: jax.Array | None,
    flags_so_far: jax.Array | np.uint32,
) -> MapState:
    if cloud.shape[0] == 0:
        cloud = jnp.full((1, 3), jnp.nan, jnp.float32)
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    step = run_stages(begin(state, cloud, finite, pose, robot, noise, flags_so_far), CHECKS)
    return cond(
        is_accepted(step),
        lambda _, step: run_stages(step, FUSION).state,
        refuse,
        state,
        step,
    )


_update_jit = jax.jit(_update)
# Also leaves that an update does not read are donated.
_update_donating = jax.jit(_update, donate_argnums=0, keep_unused=True)
