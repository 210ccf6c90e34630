"""Makes a map, updates it with clouds, copies it for planners, and enlarges it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.evidence import empty_grid
from hiosdf_jax._src.mapping.calibration import initial_optimism
from hiosdf_jax._src.mapping.stages import (
    CHECKS,
    FUSION,
    begin,
    is_accepted,
    refuse,
    run_stages,
)
from hiosdf_jax._src.network.training import init_network
from hiosdf_jax._src.numerics.arrays import on_device, scalar
from hiosdf_jax._src.numerics.intake import as_array, as_key, is_traced
from hiosdf_jax._src.numerics.modes import cond, plain
from hiosdf_jax._src.numerics.posed_cloud import (
    as_traced,
    check_extras,
    check_pose,
    checked_cloud,
    pad_rows,
    prepare,
    warn_out_of_range,
    warn_outside,
)
from hiosdf_jax._src.state import Field, MapState, Report, check_map, field_of


def init(config: Config, key: jax.Array) -> MapState:
    """Makes an empty map.

    Args:
        config: The map's configuration.
        key: Source of all the map's randomness, from `jax.random.key` (or `PRNGKey`).

    Returns:
        The map; its distances are those of an untrained network.

    Raises:
        ValueError: `config` is not a Config, or `key` is not one key.

    Example:
        >>> config = hio.Config.light(bounds=((0, 0, 0), (10, 8, 3)))
        >>> state = hio.init(config, jax.random.key(0))
    """
    if not isinstance(config, Config):
        raise ValueError(f"config is {type(config).__name__}, expected a hiosdf_jax.Config")
    key = as_key("key", key)
    key, network_key = jax.random.split(key)

    def zero() -> jax.Array:  # one array per leaf, so that the state can be donated
        return jnp.zeros((), jnp.int32)

    return MapState(
        config=config,
        grid=empty_grid(config),
        network=init_network(config, network_key),
        optimism=initial_optimism(),
        key=key,
        updates=zero(),
        report=Report(
            points_used=zero(),
            points_outside=zero(),
            points_out_of_range=zero(),
            points_invalid=zero(),
            sdf_loss=jnp.zeros((), jnp.float32),
            eikonal_loss=jnp.zeros((), jnp.float32),
            points_moving=zero(),
            refused_in_row=zero(),
            update_flags=jnp.zeros((), jnp.uint32),
            flags=jnp.zeros((), jnp.uint32),
        ),
    )


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
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns and are ignored.
        pose: (4, 4) T_world_sensor, rigid.
        donate: Reuse the memory of `state` for the new map. This is faster on a GPU, not on a CPU.
            The old map, its `report` and a `BackgroundMapper` that began with it become invalid.
            Results of `snapshot`, `bake` and `grow` stay valid. A ValueError donates nothing.
            Inside jit this has no effect: donate the arguments of the outer function instead.
        robot: Centers (K, 3) m and radii (K,) m of spheres that cover the robot, for instance from
            `planning.place_spheres`. The centers are in the world frame, at the time of the cloud.
            Returns on them leave no surface and clear no space: those within 3 cm, or three
            standard deviations of their range if that is more. Surfaces that were mapped inside
            the spheres are removed, and their space counts as free.
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
    check_map(state)
    extras = check_extras(robot, noise)
    if is_traced(*jax.tree.leaves((state, extras)), cloud, pose):
        return trace_update(state, *as_traced(cloud, pose), *extras)
    config = state.config
    cloud, pose = prepare(cloud, pose, config.max_points)
    limits = (config.min_range, config.max_range, config.min_in_range)
    if not warn_out_of_range(cloud, *limits):
        warn_outside(cloud, pose, config.bounds, *limits)
    return run_update(state, cloud, pose, extras, scalar(0, np.uint32), donate)


def run_update(
    state: MapState, cloud: Any, pose: Any, extras: Any, raised: jax.Array, donate: bool
) -> MapState:
    """Runs the compiled update, the same one for `update` and for tracking.

    Args:
        state: The map so far.
        cloud: (max_points, 3) float32, checked and padded.
        pose: (4, 4) float32.
        extras: `robot` and `noise`, checked.
        raised: Flags that refuse the cloud already, () uint32.
        donate: As for `update`.

    Returns:
        The new map.
    """
    compiled = _update_donating if donate else _update_jit
    return compiled(state, jax.device_put(cloud), jax.device_put(pose), *extras, raised)


def pad_cloud(config: Config, cloud: Any, pose: Any = None) -> np.ndarray:
    """Brings a cloud to `config.max_points` rows, as `update` does outside jit.

    In a loop inside `jit`, clouds of other sizes would compile `update` again. Pad them first.

    Args:
        config: The map's configuration.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns. Not inside jit.
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
    return pad_rows(checked_cloud(cloud), config.max_points, pose)


def snapshot(state: MapState, stamp: float | jax.Array = 0.0) -> Field:
    """Copies what queries need, so that a planner can hold it while the map is updated.

    Args:
        state: The map.
        stamp: Time of the snapshot, s on the caller's clock. It is stored as float32, so count from
            the start of the run.

    Returns:
        A field that shares no memory with the map.

    Raises:
        ValueError: `state` is not a map, or `stamp` is not one number, finite in float32.

    Example:
        field = hio.snapshot(state, stamp=12.5)
        distance = hio.sdf(field, [1.0, 2.0, 0.5])  # while `state` is updated
    """
    check_map(state, stacked=True)
    seconds = as_array("stamp", stamp)
    if seconds.shape != () or not (is_traced(seconds) or np.isfinite(jax.device_get(seconds))):
        raise ValueError(f"stamp is {stamp!r}, expected a finite number of seconds")
    field = jax.tree.map(jnp.copy, field_of(state))
    return field.replace(stamp=on_device("stamp", seconds))


def grow(state: MapState, bounds: Any) -> MapState:
    """Enlarges the box of a map and keeps its content.

    Args:
        state: The map. Not inside jit, since the arrays change their shapes.
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame; they contain the old bounds.

    Returns:
        The map in the new box. It shares no memory with the old map, and answers bit by bit as
        before inside the old box.

    Raises:
        ValueError: `state` is not a map, or traced; or the new bounds do not contain the old ones,
            or are none.

    Example:
        state = hio.grow(state, ((-5, -5, 0), (15, 10, 3)))  # it must contain the old box
    """
    check_map(state)
    if is_traced(*jax.tree.leaves(state)):
        raise ValueError("state is traced, expected a map: call grow outside jit")
    old = state.config
    new = dataclasses.replace(old, bounds=bounds)
    contained = np.all(np.asarray(new.bounds[0]) <= old.bounds[0]) and np.all(
        np.asarray(new.bounds[1]) >= old.bounds[1]
    )
    if not contained:
        raise ValueError(f"bounds is {bounds!r}, expected a box that contains {old.bounds!r}")
    start = np.subtract(old.corner_index, new.corner_index)
    place = tuple(slice(a, a + n) for a, n in zip(start, old.grid_shape, strict=True))
    grid = jax.tree.map(
        lambda empty, known: empty.at[place].set(known), empty_grid(new), state.grid
    )
    rest = jax.tree.map(jnp.copy, state.replace(grid=None))  # so that either map can be donated
    return rest.replace(config=new, grid=grid)


@plain
def trace_update(
    state: MapState,
    cloud: jax.Array,
    pose: jax.Array,
    robot: tuple[jax.Array, jax.Array] | None = None,
    noise: jax.Array | None = None,
    raised: jax.Array | int = 0,
) -> MapState:
    """Updates a map inside jit, where shapes are used as they are; see `run_update`."""
    if cloud.shape[0] == 0:
        cloud = jnp.full((1, 3), jnp.nan, jnp.float32)
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    step = run_stages(begin(state, cloud, finite, pose, robot, noise, raised), CHECKS)
    return cond(
        is_accepted(step),
        lambda _, step: run_stages(step, FUSION).state,
        refuse,
        state,
        step,
    )


_update_jit = jax.jit(trace_update)
# Also leaves that an update does not read are donated.
_update_donating = jax.jit(trace_update, donate_argnums=0, keep_unused=True)
