"""An update taken apart: each stage with the arguments that `mapping._integrate` gives it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.points import field_of
from hiosdf_jax._src.grid import carving, distance, evidence, frontier, patches
from hiosdf_jax._src.grid.change import change_by
from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.mapping import calibration, pipeline
from hiosdf_jax._src.network import training
from hiosdf_jax._src.samples import from_grid
from hiosdf_jax._src.samples.draw import concatenate
from hiosdf_jax._src.samples.from_cloud import sample_local
from hiosdf_jax._src.state import MapState


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
    beams = jax.jit(place_cloud, static_argnums=0)(config, cloud, finite, pose)
    sensor_world = beams.sensor_world
    stages: dict[str, Stage] = {}

    def stage(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        compiled = jax.jit(function)
        result = jax.block_until_ready(compiled(*arguments))
        stages[name] = Stage(name, compiled, arguments, result)
        return result

    def fade(grid: Any, start: jax.Array, window: Any) -> Any:
        return evidence.write_evidence(grid, start, evidence.fade_evidence(config, window))

    stage(
        "calibration",
        calibration.calibrate,
        field_of(state),
        beams.points_world,
        beams.ends & beams.inside,
        sensor_world,
        check_key,
    )
    start, window = stage(
        "window", partial(evidence.read_evidence, config), state.grid, sensor_world
    )
    window = stage(
        "fusion",
        partial(patches.fuse_hits, config),
        window,
        start,
        beams.points_world,
        beams.ends,
        sensor_world,
    )
    window = stage(
        "rays",
        partial(carving.trace_rays, config),
        window,
        start,
        beams,
    )
    grid = stage("fading", fade, state.grid, start, window)
    change = change_by(beams)
    grid = stage(
        "distance",
        partial(distance.update_distances, config),
        grid,
        change,
    )
    grid = stage(
        "frontier",
        partial(frontier.update_frontier, config),
        grid,
        change,
    )
    global_samples = stage(
        "grid samples",
        partial(from_grid.sample_grid, config),
        grid,
        grid_key,
    )
    local_samples = stage(
        "local samples",
        partial(sample_local, config),
        beams.points_world,
        beams.ends,
        sensor_world,
        local_key,
    )
    stage(
        "training",
        partial(training.train, config),
        state.network,
        concatenate(global_samples, local_samples),
        *pipeline.schedule(config, state.updates),
        order_key,
    )
    return stages
