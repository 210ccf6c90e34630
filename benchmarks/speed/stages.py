"""Task that times the stages of an update one by one."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from benchmarks.speed import baselines, limits
from benchmarks.speed.rows import Measured, time_ms
from benchmarks.speed.setup import Frame
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import distance, evidence, geometry
from hiosdf_jax._src.grid.windows import RayBox, Window, box_of_rays, place_windows
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.mapping.stages import STAGES, Step, begin
from hiosdf_jax._src.state.pytrees import Evidence, MapState

_COMPARE = {
    "update_distances": "distance",
    "update_frontier": "frontier",
    "sample_cloud": "nearest",
    "train": "training",
}


class Part(NamedTuple):
    """A stage of one update.

    Attributes:
        changes: The compiled stage, which returns the parts that it changes and None for others.
        before: The step that it takes.
        after: The step with these parts changed.
    """

    changes: Callable[[Step], Step]
    before: Step
    after: Step


def take_apart(state: MapState, frame: Frame) -> dict[str, Part]:
    """Runs an update stage by stage.

    Args:
        state: The map.
        frame: The update's cloud and pose.

    Returns:
        The stages by name, in order.
    """
    cloud, pose = map(jnp.asarray, pipeline.check_and_pad(*frame, state.config.max_points))
    step = jax.jit(begin)(state, cloud, jnp.all(jnp.isfinite(cloud), axis=-1), pose)
    parts = {}
    for stage in STAGES:
        changes = jax.jit(functools.partial(_changes, stage))
        after = jax.tree.map(
            lambda old, new: old if new is None else new,
            step,
            changes(step),
            is_leaf=lambda part: part is None,
        )
        parts[stage.__name__] = Part(changes, step, after)
        step = after
    return parts


def time_parts(
    label: str, parts: Mapping[str, Part], machine: limits.Limits, seconds: float
) -> Measured:
    """Times each stage of an update by itself, and scipy beside three of them.

    Args:
        label: Name of the configuration.
        parts: The stages, from `take_apart`.
        machine: The machine's rates.
        seconds: How long to time each stage.

    Returns:
        Rows in ms by the stages' names.
    """
    step = parts["sample_cloud"].after
    config, known = step.config, step.state.grid.evidence
    box = box_of_rays(step.rays)
    searched = _searched(config, box, config.horizon_voxels)
    seen_in = _searched(config, box, config.frontier_voxels)
    work = {
        "update_distances": limits.distance_work(config, searched),
        "train": limits.training_work(config),
    }
    rows = []
    for name, part in tqdm(parts.items(), desc=label, leave=False):
        spread = time_ms(part.changes, part.before, seconds=seconds)
        compare = _COMPARE.get(name, "")
        rows.append(limits.row(machine, f"{name}, {label}", spread, work.get(name), compare))
    count = config.local_points * config.local_ray_samples
    from_cloud = np.asarray(step.samples.points_world[-count:])
    points = np.asarray(step.rays.points_world)[np.asarray(step.rays.ends)]
    return Measured(
        rows,
        {
            "nearest": baselines.nearest(from_cloud, points, seconds),
            "distance": baselines.distance(*_sites(config, known, searched), seconds),
            "frontier": baselines.frontier(_observed(config, known, seen_in), seconds),
        },
    )


def _changes(stage: Callable[[Step], Step], step: Step) -> Step:
    """Runs a stage without what it leaves unchanged: jit would copy the whole map."""
    given = dict(jax.tree.leaves_with_path(step))
    return jax.tree.map_with_path(
        lambda path, leaf: None if given.get(path) is leaf else leaf, stage(step)
    )


def _searched(config: Config, box: RayBox, horizon_voxels: int) -> Window:
    """The window in which a stage recomputes its distances."""
    small, large, fits = place_windows(config, box, horizon_voxels * config.voxel_size)
    return small if fits else large


def _sites(config: Config, known: Evidence, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """The voxels that the two searches of the distance transform look for."""
    arrays = (
        geometry.read_window(array, window.start, window.shape).astype(jnp.float32)
        for array in (known.hits, known.passes, known.behind, known.root_weight, known.axes)
    )
    features, doubtful = np.asarray(distance.find_sites(config, *arrays))
    return features, doubtful


def _observed(config: Config, known: Evidence, window: Window) -> np.ndarray:
    """The observed voxels of a window."""
    passes, hits, behind = (
        geometry.read_window(array, window.start, window.shape).astype(jnp.float32)
        for array in (known.passes, known.hits, known.behind)
    )
    return np.asarray(evidence.is_observed(config, passes, hits, behind))
