"""Makes a map, copies it for planners, and enlarges it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.evidence import empty_grid
from hiosdf_jax._src.mapping.calibration import initial_optimism
from hiosdf_jax._src.network.training import init_network
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.intake import as_array, as_key, is_traced
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import Field, MapState, Report, field_of


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
    key = as_key("key", key, batched="jax.vmap(functools.partial(hio.init, config))(keys)")
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


def snapshot(state: MapState, stamp: float | jax.Array = 0.0) -> Field:
    """Copies what queries need, so that a planner can hold it while the map is updated.

    Args:
        state: The map, or a stack of maps.
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
    # A stack of maps has a stamp for each, so that `vmap` can take its fields apart.
    stamps = jnp.broadcast_to(on_device("stamp", seconds), jnp.shape(state.updates))
    return field.replace(stamp=stamps)


def grow(state: MapState, bounds: Any) -> MapState:
    """Enlarges the box of a map and keeps its content.

    Args:
        state: The map. Not inside jit, since the arrays change their shapes.
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame; they contain the old bounds.

    Returns:
        The map in the new box. It shares no memory with the old map, and answers bit for bit as
        before inside the old box.

    Raises:
        ValueError: `state` is not a map, or traced; or the new bounds are invalid or do not contain
            the old ones.

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
