"""The map's life: `init`, `update`, `snapshot`, `grow`. The one place where the stages meet."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.field.points import field_of
from hiosdf_jax._src.grid import carving, distance, evidence, frontier, patches
from hiosdf_jax._src.grid.change import change_by
from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.mapping import calibration, intake
from hiosdf_jax._src.network import training
from hiosdf_jax._src.numerics.posed_cloud import check_shapes
from hiosdf_jax._src.numerics.rigid import is_rigid
from hiosdf_jax._src.samples import from_grid
from hiosdf_jax._src.samples.draw import concatenate
from hiosdf_jax._src.samples.from_cloud import sample_local
from hiosdf_jax._src.state import Field, Flag, MapState, Report


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
        optimism=calibration.initial(),
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


def update(state: MapState, cloud: Any, pose: Any, *, donate: bool = False) -> MapState:
    """Fuses one posed point cloud into the map.

    Pure: the given state stays valid, unless it is donated. Called with concrete arrays it checks
    them, pads or draws the cloud to `config.max_points` rows and runs one compiled function; called
    inside `jit`, `lax.scan` or `vmap` it takes the shapes as they are and reports by
    `state.report.flags`. Under `vmap` what is computed in the smaller window of two is computed in
    both.

    Args:
        state: The map so far.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns and are ignored.
        pose: (4, 4) T_world_sensor, rigid.
        donate: Give the memory of `state` to the new map, which is ready sooner then on a GPU, but
            not on a CPU. Afterwards neither the old map can be used nor what shares arrays with it:
            its `report`, or a `BackgroundMapper` that began with it. What `snapshot`, `bake` and
            `grow` made of it stays valid. If this raises a ValueError, nothing has been donated.
            Inside jit it has no effect: donate the arguments of that function instead.

    Returns:
        The new map.

    Raises:
        ValueError: A shape is wrong; outside jit also: the pose is not finite or not rigid, or
            the cloud has no finite row.
    """
    if not isinstance(state, MapState):
        raise ValueError(f"state is {type(state).__name__}, expected a MapState from hio.init")
    leaves = (*jax.tree.leaves(state), cloud, pose)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        check_shapes(cloud, pose)
        return _update(state, jnp.asarray(cloud), jnp.asarray(pose))
    compiled = _update_donating if donate else _update_jit
    return compiled(state, *intake.prepare(cloud, pose, state.config.max_points))


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
        The map in the new box, which shares no memory with the old one. Inside the old box it
        answers bit by bit as before.

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
    rest = jax.tree.map(jnp.copy, state.replace(grid=None))  # either map can be donated
    return rest.replace(config=new, grid=grid)


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
_update_donating = jax.jit(_update, donate_argnums=0)


def _integrate(state: MapState, cloud: jax.Array, finite: jax.Array, pose: jax.Array) -> MapState:
    config = state.config
    key, grid_key, local_key, order_key, check_key = jax.random.split(state.key, 5)

    beams = place_cloud(config, cloud, finite, pose)
    sensor_world = beams.sensor_world

    # How well the map so far foretold the newest cloud.
    used = beams.ends & beams.inside
    optimism = calibration.calibrate(
        field_of(state), beams.points_world, used, sensor_world, check_key
    )

    # The coarse grid (paper, IV-B).
    start, window = evidence.read_evidence(config, state.grid, sensor_world)
    window = patches.fuse_hits(config, window, start, beams.points_world, beams.ends, sensor_world)
    window = carving.trace_rays(config, window, start, beams)
    window = evidence.fade_evidence(config, window)
    grid = evidence.write_evidence(state.grid, start, window)
    change = change_by(beams)
    grid = distance.update_distances(config, grid, change)
    grid = frontier.update_frontier(config, grid, change)

    # What the network learns from (IV-B, IV-C), and its fit (IV-D).
    samples = concatenate(
        from_grid.sample_grid(config, grid, grid_key),
        sample_local(config, beams.points_world, beams.ends, sensor_world, local_key),
    )
    extra_epochs, average = schedule(config, state.updates)
    network, parts, trained = training.train(
        config, state.network, samples, extra_epochs, average, order_key
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
        extra_epochs: () int32, beyond those that every update makes.
        average: () share of the old weights in those that are served; a running mean over the
            first updates, so that the untrained network is never served.
    """
    epochs = jnp.where(updates < config.warmup_updates, config.warmup_epochs, config.epochs)
    extra_epochs = epochs - training.least_epochs(config)
    return extra_epochs, jnp.minimum(config.weight_average, updates / (updates + 1.0))


def _typed_key(key: Any) -> jax.Array:
    array = jnp.asarray(key) if not isinstance(key, jax.Array) else key
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) and array.shape == ():
        return array
    if array.dtype == jnp.uint32 and array.shape == (2,):
        return jax.random.wrap_key_data(array)
    raise ValueError(
        f"key has dtype {array.dtype} and shape {array.shape}, expected one jax.random.key"
    )
