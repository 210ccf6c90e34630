"""An update taken apart: each stage with the arguments that `mapping._integrate` gives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax import mapping, uncertainty
from hiosdf_jax.grid import distance, frontier, geometry, rays, sampling, surface
from hiosdf_jax.local import sample_local
from hiosdf_jax.network import training
from hiosdf_jax.query import field_of
from hiosdf_jax.samples import concatenate
from hiosdf_jax.state import MapState


class Stage(NamedTuple):
    """A compiled stage, its arguments, and what it answered."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    result: Any


def take_apart(state: MapState, cloud: jax.Array, pose: jax.Array) -> dict[str, Stage]:
    """Runs an update stage by stage.

    Args:
        state: The map.
        cloud: (max_points, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.

    Returns:
        The stages by name, in their order.
    """
    config = state.config
    _, grid_key, local_key, order_key, check_key = jax.random.split(state.key, 5)
    cloud, pose = jnp.asarray(cloud, jnp.float32), jnp.asarray(pose, jnp.float32)
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    cloud = jnp.where(finite[:, None], cloud, 0)
    ranges = surface.safe_norm(cloud)
    in_range = finite & (ranges >= config.min_range)
    ends = in_range & (ranges <= config.max_range)
    sensor_world = pose[:3, 3]
    offsets_world = jnp.sum(cloud[:, None, :] * pose[:3, :3], axis=-1)
    points_world = sensor_world + offsets_world
    directions_world = offsets_world / jnp.maximum(ranges, 1e-6)[:, None]
    _, _, inside = geometry.voxel_of(config, points_world)
    free = jnp.minimum(ranges, config.max_range)
    stages: dict[str, Stage] = {}

    def stage(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        compiled = jax.jit(function)
        result = jax.block_until_ready(compiled(*arguments))
        stages[name] = Stage(name, compiled, arguments, result)
        return result

    def fade(grid: Any, sensor_world: jax.Array) -> Any:
        grid = rays.fade_evidence(config, grid, sensor_world)
        return mapping._narrow(grid)

    def train(network: Any, samples: Any, epochs: Any, average: Any, key: jax.Array) -> Any:
        return training.train(config, network, samples, epochs, average, key)

    stage(
        "calibration",
        uncertainty.calibrate,
        field_of(state),
        points_world,
        ends & inside,
        sensor_world,
        check_key,
    )
    grid = mapping._widen(state.grid)
    grid = stage(
        "fusion",
        lambda *arguments: surface.fuse_hits(config, *arguments),
        grid,
        points_world,
        ends,
        sensor_world,
    )
    grid = stage(
        "rays",
        lambda *arguments: rays.trace_rays(config, *arguments),
        grid,
        directions_world,
        free,
        in_range,
        ends,
        sensor_world,
    )
    grid = stage("fading", fade, grid, sensor_world)
    grid = stage(
        "distance",
        lambda *arguments: distance.update_distances(config, *arguments),
        grid,
        sensor_world,
    )
    grid = stage(
        "frontier",
        lambda *arguments: frontier.update_frontier(config, *arguments),
        grid,
        sensor_world,
    )
    global_samples = stage(
        "grid samples",
        lambda *arguments: sampling.sample_grid(config, *arguments),
        grid,
        grid_key,
    )
    local_samples = stage(
        "local samples",
        lambda *arguments: sample_local(config, *arguments),
        points_world,
        ends,
        sensor_world,
        local_key,
    )
    warming = state.updates < config.warmup_updates
    stage(
        "training",
        train,
        state.network,
        concatenate(global_samples, local_samples),
        jnp.where(warming, config.warmup_epochs, config.epochs),
        jnp.minimum(config.weight_average, state.updates / (state.updates + 1.0)),
        order_key,
    )
    return stages
