"""The map's life: `init`, `update`, `snapshot`, `grow`. The one place where the stages meet."""

from __future__ import annotations

import dataclasses
import zlib
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax import uncertainty
from hiosdf_jax.config import Config
from hiosdf_jax.grid import distance, evidence, frontier, rays, sampling, surface
from hiosdf_jax.grid.beams import place_cloud
from hiosdf_jax.grid.change import change_by
from hiosdf_jax.local import sample_local
from hiosdf_jax.network import training
from hiosdf_jax.query import field_of
from hiosdf_jax.rigid import is_rigid
from hiosdf_jax.samples import concatenate
from hiosdf_jax.state import Field, Flag, MapState, Report


def init(config: Config, key: jax.Array) -> MapState:
    """Makes an empty map.

    Args:
        config: The map's configuration.
        key: Source of all the map's randomness, from `jax.random.key` (or `PRNGKey`).

    Returns:
        The map; its distances are those of an untrained network.

    Raises:
        ValueError: An argument is not what it should be.
    """
    if not isinstance(config, Config):
        raise ValueError(f"config is {type(config).__name__}, expected a hiosdf_jax.Config")
    key = _typed_key(key)
    key, network_key = jax.random.split(key)

    def zero() -> jax.Array:  # an array of its own each, so that the state can be donated
        return jnp.zeros((), jnp.int32)

    return MapState(
        config=config,
        grid=evidence.empty_grid(config),
        network=training.init_network(config, network_key),
        optimism=uncertainty.initial(),
        key=key,
        updates=zero(),
        report=Report(
            points_used=zero(),
            points_outside=zero(),
            points_out_of_range=zero(),
            points_invalid=zero(),
            sdf_loss=jnp.zeros((), jnp.float32),
            eikonal_loss=jnp.zeros((), jnp.float32),
            flags=jnp.zeros((), jnp.uint32),
        ),
    )


def update(state: MapState, cloud: Any, pose: Any) -> MapState:
    """Fuses one posed point cloud into the map.

    Pure: the given state stays valid. Called with concrete arrays it checks them, pads or draws
    the cloud to `config.max_points` rows and runs one compiled function; called inside `jit`,
    `lax.scan` or `vmap` it takes the shapes as they are and reports by `state.report.flags`.

    Args:
        state: The map so far.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns and are ignored.
        pose: (4, 4) T_world_sensor, rigid.

    Returns:
        The new map.

    Raises:
        ValueError: A shape is wrong; outside jit also: the pose is not finite or not rigid, or
            the cloud has no finite row.
    """
    if not isinstance(state, MapState):
        raise ValueError(f"state is {type(state).__name__}, expected a MapState from hio.init")
    _check_shapes(cloud, pose)
    leaves = (*jax.tree.leaves(state), cloud, pose)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return _update(state, jnp.asarray(cloud), jnp.asarray(pose))
    cloud, pose = np.asarray(cloud, np.float32), np.asarray(pose, np.float32)
    _check_values(cloud, pose)
    return _update_jit(state, _to_capacity(cloud, pose, state.config.max_points), pose)


def snapshot(state: MapState, stamp: float | jax.Array = 0.0) -> Field:
    """Copies what queries need, so that a planner can hold it while the map goes on.

    Args:
        state: The map.
        stamp: When that is, s on the caller's clock; kept as float32, so count from a start.

    Returns:
        A field that shares no memory with the map.
    """
    field = jax.tree.map(jnp.copy, field_of(state))
    return field.replace(stamp=jnp.asarray(stamp, jnp.float32))


def grow(state: MapState, bounds: Any) -> MapState:
    """Enlarges the box of a map and keeps all that it knows.

    Args:
        state: The map; not inside jit, since the arrays change their shapes.
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame; contains the old bounds.

    Returns:
        The map in the new box. Inside the old one it answers bit by bit as before.

    Raises:
        ValueError: The new bounds do not contain the old ones.
    """
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
        lambda empty, known: empty.at[place].set(known), evidence.empty_grid(new), state.grid
    )
    return state.replace(config=new, grid=grid)


def _update(state: MapState, cloud: jax.Array, pose: jax.Array) -> MapState:
    cloud, pose = cloud.astype(jnp.float32), pose.astype(jnp.float32)
    if cloud.shape[0] == 0:
        cloud = jnp.full((1, 3), jnp.nan, jnp.float32)
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    rigid = is_rigid(pose)
    usable = rigid & jnp.any(finite)
    flags = (
        state.report.flags
        | jnp.where(rigid, 0, Flag.BAD_POSE).astype(jnp.uint32)
        | jnp.where(jnp.any(finite), 0, Flag.EMPTY_CLOUD).astype(jnp.uint32)
    )
    state = state.replace(report=state.report.replace(flags=flags))
    return jax.lax.cond(usable, _integrate, lambda state, *_: state, state, cloud, finite, pose)


_update_jit = jax.jit(_update)


def _integrate(state: MapState, cloud: jax.Array, finite: jax.Array, pose: jax.Array) -> MapState:
    config = state.config
    key, grid_key, local_key, order_key, check_key = jax.random.split(state.key, 5)

    beams = place_cloud(config, cloud, finite, pose)
    sensor_world = beams.sensor_world

    # How well the map so far foretold the newest cloud.
    used = beams.ends & beams.inside
    optimism = uncertainty.calibrate(
        field_of(state), beams.points_world, used, sensor_world, check_key
    )

    # The coarse grid (paper, IV-B).
    start, window = evidence.read_evidence(config, state.grid, sensor_world)
    window = surface.fuse_hits(config, window, start, beams.points_world, beams.ends, sensor_world)
    window = rays.trace_rays(config, window, start, beams)
    window = rays.fade_evidence(config, window)
    grid = evidence.write_evidence(state.grid, start, window)
    change = change_by(beams)
    grid = distance.update_distances(config, grid, change)
    grid = frontier.update_frontier(config, grid, change)

    # What the network learns from (IV-B, IV-C), and its fit (IV-D).
    samples = concatenate(
        sampling.sample_grid(config, grid, grid_key),
        sample_local(config, beams.points_world, beams.ends, sensor_world, local_key),
    )
    epochs, average = schedule(config, state.updates)
    network, parts, trained = training.train(
        config, state.network, samples, epochs, average, order_key
    )

    outside = beams.ends & ~beams.inside
    flags = (
        state.report.flags
        | jnp.where(jnp.any(outside), Flag.POINTS_OUTSIDE, 0).astype(jnp.uint32)
        | jnp.where(trained, 0, Flag.TRAINING_FAILED).astype(jnp.uint32)
    )

    def count(rows: jax.Array) -> jax.Array:
        return jnp.sum(rows, dtype=jnp.int32)

    return state.replace(
        grid=grid,
        network=network,
        optimism=optimism,
        key=key,
        updates=state.updates + 1,
        report=Report(
            points_used=count(used),
            points_outside=count(outside),
            points_out_of_range=count(finite & ~beams.ends),
            points_invalid=count(~finite),
            sdf_loss=parts.sdf,
            eikonal_loss=parts.eikonal,
            flags=flags,
        ),
    )


def schedule(config: Config, updates: jax.Array) -> tuple[jax.Array, jax.Array]:
    """How the network is trained at an update.

    Args:
        config: The map's configuration.
        updates: () int32, that the map has had.

    Returns:
        epochs: () int32.
        average: () share of the old weights in those that are served; a running mean over the
            first updates, so that the untrained network is never served.
    """
    epochs = jnp.where(updates < config.warmup_updates, config.warmup_epochs, config.epochs)
    return epochs, jnp.minimum(config.weight_average, updates / (updates + 1.0))


def _check_shapes(cloud: Any, pose: Any) -> None:
    if np.ndim(cloud) != 2 or np.shape(cloud)[1] != 3:
        raise ValueError(f"cloud has shape {np.shape(cloud)}, expected (N, 3)")
    if np.shape(pose) != (4, 4):
        raise ValueError(f"pose has shape {np.shape(pose)}, expected (4, 4)")


def _check_values(cloud: np.ndarray, pose: np.ndarray) -> None:
    if not np.isfinite(pose).all():
        raise ValueError(f"pose has values that are not finite, expected T_world_sensor: {pose}")
    if not is_rigid(pose, np):
        raise ValueError(f"pose is not rigid, expected a rotation and a translation: {pose}")
    if not _finite_rows(cloud).any():
        raise ValueError(
            f"cloud has no finite row among its {len(cloud)}, expected at least one return"
        )


def _to_capacity(cloud: np.ndarray, pose: np.ndarray, capacity: int) -> np.ndarray:
    """Pads a cloud with NaN rows, or draws from its finite rows, to (capacity, 3)."""
    padded = np.full((capacity, 3), np.nan, np.float32)
    if len(cloud) <= capacity:
        padded[: len(cloud)] = cloud
        return padded
    rows = np.flatnonzero(_finite_rows(cloud))
    if len(rows) > capacity:
        # The draw must be a function of the arguments alone, and differ from cloud to cloud.
        rng = np.random.default_rng(zlib.crc32(pose.tobytes(), len(rows)))
        dropped = len(rows) - capacity
        fewer = min(capacity, dropped)
        chosen = rng.choice(len(rows), fewer, replace=False, shuffle=False)
        kept = np.full(len(rows), fewer == dropped)
        kept[chosen] = fewer != dropped  # chosen are those to drop, or those to keep
        rows = rows[kept]
    np.take(cloud, rows, axis=0, out=padded[: len(rows)], mode="clip")
    return padded


def _finite_rows(cloud: np.ndarray) -> np.ndarray:
    finite = np.isfinite(cloud)
    return finite[:, 0] & finite[:, 1] & finite[:, 2]  # several times faster than all(axis=1)


def _typed_key(key: Any) -> jax.Array:
    array = jnp.asarray(key) if not isinstance(key, jax.Array) else key
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) and array.shape == ():
        return array
    if array.dtype == jnp.uint32 and array.shape == (2,):
        return jax.random.wrap_key_data(array)
    raise ValueError(
        f"key has dtype {array.dtype} and shape {array.shape}, expected one jax.random.key"
    )
