"""The stages of an update, in order.

Each stage maps a `Step` to a `Step` and replaces some of its parts. `run_stages` runs the list, and
a profiler shows each stage under its name. The speed benchmark times the same list.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient as constant  # derivatives take it as it is

from hiosdf_jax._src.change import (
    directions,
    hiding,
    leftovers,
    novelty,
    robot,
    smoothing,
    stray,
    vanishing,
)
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import carving, distance, evidence, frontier, patches, rays, windows
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.mapping import calibration
from hiosdf_jax._src.network import loss, training
from hiosdf_jax._src.numerics.rigid import is_rigid
from hiosdf_jax._src.numerics.robot_and_noise import extras_are_valid
from hiosdf_jax._src.samples import from_cloud, from_grid
from hiosdf_jax._src.samples.draw import Samples, concatenate
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import Grid, MapState, Report, field_of

_LATER: Any = None  # a part that a later stage makes


class Keys(NamedTuple):
    """Sources of randomness of one update.

    Attributes:
        bound: Returns that calibrate the lower bound.
        grid: Samples from the grid.
        cloud: Samples from the cloud.
        order: Order of the samples in training.
    """

    bound: jax.Array
    grid: jax.Array
    cloud: jax.Array
    order: jax.Array


class Step(NamedTuple):
    """An update in progress. Parts that later stages make are None.

    Attributes:
        state: The map; stages replace its parts.
        cloud: (N, 3) float32, m, sensor frame.
        finite: Rows of the cloud that are returns, (N,) bool.
        pose: (4, 4) float32, T_world_sensor.
        keys: Sources of randomness.
        robot: Centers (K, 3) and radii (K,) of the robot's spheres, m, world frame, or None.
        noise: (a, b) of the cloud's noise, or None for that of the configuration.
        flags: Bits of `Flag` of this update, () uint32.
        out_of_range: Returns nearer than min_range or farther than max_range, () int32.
        rays: The cloud in the world frame.
        novelty: The cloud compared with the map before it.
        before: The evidence around the sensor before this cloud, float32.
        window: The same with this cloud.
        changed: Share of the surface that the cloud saw appear or vanish, ().
        samples: Training samples.
        losses: Mean losses of the last epoch.
        trained: Whether training was finite, () bool.
    """

    state: MapState
    cloud: jax.Array
    finite: jax.Array
    pose: jax.Array
    keys: Keys
    robot: tuple[jax.Array, jax.Array] | None = None
    noise: jax.Array | None = None
    flags: jax.Array = _LATER
    out_of_range: jax.Array = _LATER
    rays: Rays = _LATER
    novelty: novelty.Novelty = _LATER
    before: evidence.EvidenceWindow = _LATER
    window: evidence.EvidenceWindow = _LATER
    changed: jax.Array = _LATER
    samples: Samples = _LATER
    losses: loss.Losses = _LATER
    trained: jax.Array = _LATER

    @property
    def config(self) -> Config:
        """The map's configuration."""
        return self.state.config


Stage = Callable[[Step], Step]


def begin(
    state: MapState,
    cloud: jax.Array,
    finite: jax.Array,
    pose: jax.Array,
    robot: tuple[jax.Array, jax.Array] | None = None,
    noise: jax.Array | None = None,
    flags_so_far: jax.Array | np.uint32 | int = 0,
) -> Step:
    """Starts an update: draws its keys, stores the next one in the map, adds to its flags."""
    flags = flags_so_far | jnp.where(jnp.any(finite), 0, Flag.EMPTY_CLOUD)
    flags |= jnp.where(is_rigid(pose), 0, Flag.BAD_POSE)
    flags |= jnp.where(extras_are_valid(robot, noise), 0, Flag.BAD_ARGUMENT)
    key, grid_key, cloud_key, order_key, bound_key = jax.random.split(state.key, 5)
    keys = Keys(bound=bound_key, grid=grid_key, cloud=cloud_key, order=order_key)
    state = state.replace(key=key)
    return Step(state, cloud, finite, pose, keys, robot, noise, flags.astype(jnp.uint32))


def place_cloud(step: Step) -> Step:
    """Transforms the cloud to the world frame, without the returns on the robot."""
    config = step.config
    placed = rays.place_cloud(config, step.cloud, step.finite, step.pose, step.noise)
    usable, returns = jnp.sum(placed.ends), jnp.sum(step.finite)
    too_few = (step.flags == 0) & (usable < config.min_in_range * returns)
    if step.robot is not None:
        placed = rays.remove_robot(placed, *step.robot)
    step = step._replace(rays=placed, out_of_range=(returns - usable).astype(jnp.int32))
    return _flag(step, Flag.OUT_OF_RANGE, too_few)


def drop_stray(step: Step) -> Step:
    """Leaves out isolated returns: they leave no surface and clear no space."""
    kept = ~stray.find_stray(constant(step.rays))
    placed = step.rays._replace(ends=step.rays.ends & kept, in_range=step.rays.in_range & kept)
    return step._replace(rays=placed)


def smooth_ranges(step: Step) -> Step:
    """Averages the ranges of a cloud whose noise is given and large."""
    if step.noise is None:
        return step
    return step._replace(rays=smoothing.smooth_ranges(step.config, step.rays))


def compare_cloud(step: Step) -> Step:
    """Finds the returns on new things, and clouds that contradict the map as a whole."""
    found = novelty.compare_cloud(
        step.config, constant(step.state.grid), constant(step.rays), step.state.updates
    )
    contradicts = (step.flags == 0) & ~found.consistent
    return _flag(step._replace(novelty=found), Flag.INCONSISTENT_CLOUD, contradicts)


def calibrate_bound(step: Step) -> Step:
    """Compares the map so far with the cloud, for the lower bound of the distance."""
    optimism = calibration.calibrate_bound(
        constant(field_of(step.state)), constant(step.rays), step.keys.bound
    )
    return step._replace(state=step.state.replace(optimism=optimism))


def read_window(step: Step) -> Step:
    """Reads the evidence within reach of the sensor."""
    window = evidence.read_window(step.config, step.state.grid.evidence, step.rays)
    return step._replace(before=window, window=window)


def fade_leftovers(step: Step) -> Step:
    """Lets new hits outweigh old ones beside a thing that has just left."""
    window = leftovers.fade_leftovers(step.config, constant(step.window), constant(step.rays))
    window = _with_patches(window, step.window)
    return step._replace(before=window, window=window)


def fuse_hits(step: Step) -> Step:
    """Merges the returns into surface patches (IV-B)."""
    return step._replace(window=patches.fuse_hits(step.config, step.window, step.rays))


def trace_rays(step: Step) -> Step:
    """Counts the rays through free voxels and marks hidden ones (IV-B)."""
    traced = carving.trace_rays(step.config, constant(step.window), constant(step.rays))
    return step._replace(window=_with_patches(traced, step.window))


def renew_evidence(step: Step) -> Step:
    """Lets new evidence outweigh old: things that appear, space that they hide, what vanished."""
    config, before, placed = step.config, constant(step.before), constant(step.rays)
    window, fresh = hiding.add_new_surfaces(
        config, before, constant(step.window), placed, step.novelty
    )
    view = directions.view_of(placed)
    window = hiding.hide_behind(config, before, window, placed, view, fresh)
    window = vanishing.drop_vanished(config, before, window, placed, view, step.state.updates)
    if step.robot is not None:
        window = robot.clear_robot(config, window, *step.robot)
    changed = vanishing.share_of_changes(before, constant(step.window), window)
    return step._replace(window=_with_patches(window, step.window), changed=changed)


def fade_evidence(step: Step) -> Step:
    """Limits the evidence that a voxel remembers."""
    return step._replace(window=evidence.fade_evidence(step.config, step.window))


def write_window(step: Step) -> Step:
    """Writes the evidence back into the grid."""
    grid = step.state.grid
    return _with_grid(
        step, grid.replace(evidence=evidence.write_window(grid.evidence, step.window))
    )


def update_distances(step: Step) -> Step:
    """Finds the nearest patch and the sign of every voxel (IV-B)."""
    grid, box = constant(step.state.grid), windows.box_of_rays(constant(step.rays))
    derived = distance.update_distances(step.config, grid, box).derived
    return _with_grid(step, step.state.grid.replace(derived=derived))


def update_frontier(step: Step) -> Step:
    """Computes every voxel's distance to unseen space."""
    grid, box = constant(step.state.grid), windows.box_of_rays(constant(step.rays))
    derived = frontier.update_frontier(step.config, grid, box).derived
    return _with_grid(step, step.state.grid.replace(derived=derived))


def sample_grid(step: Step) -> Step:
    """Draws training samples from the grid (IV-B)."""
    return step._replace(
        samples=from_grid.sample_grid(step.config, constant(step.state.grid), step.keys.grid)
    )


def sample_cloud(step: Step) -> Step:
    """Adds training samples from the newest cloud: the local SDF (IV-C)."""
    local = from_cloud.sample_cloud(step.config, constant(step.rays), step.keys.cloud)
    return step._replace(samples=concatenate(step.samples, local))


def train(step: Step) -> Step:
    """Fits the network to the samples (IV-D)."""
    extra_epochs, average = training.schedule(step.config, step.state.updates, step.changed)
    network, losses, trained = training.train(
        step.config,
        constant(step.state.network),
        step.samples,
        extra_epochs,
        average,
        step.keys.order,
    )
    state = step.state.replace(network=network)
    return step._replace(state=state, losses=losses, trained=trained)


def summarize(step: Step) -> Step:
    """Counts the update and writes its report."""
    state, ends, inside = step.state, step.rays.ends, step.rays.inside
    outside = ends & ~inside
    step = _flag(step, Flag.POINTS_OUTSIDE, jnp.any(outside))
    step = _flag(step, Flag.TRAINING_FAILED, ~step.trained)

    def count(rows: jax.Array) -> jax.Array:
        return jnp.sum(rows, dtype=jnp.int32)

    report = Report(
        points_used=count(ends & inside),
        points_outside=count(outside),
        points_out_of_range=step.out_of_range,
        points_invalid=count(~step.finite),
        sdf_loss=step.losses.sdf,
        eikonal_loss=step.losses.eikonal,
        points_moving=count(step.novelty.novel),
        refused_in_row=jnp.zeros((), jnp.int32),
        update_flags=step.flags,
        flags=state.report.flags | step.flags,
    )
    return step._replace(state=state.replace(updates=state.updates + 1, report=report))


CHECKS: tuple[Stage, ...] = (place_cloud, drop_stray, smooth_ranges, compare_cloud)
"""Stages that decide whether the cloud is fused."""

FUSION: tuple[Stage, ...] = (
    calibrate_bound,
    read_window,
    fade_leftovers,
    fuse_hits,
    trace_rays,
    renew_evidence,
    fade_evidence,
    write_window,
    update_distances,
    update_frontier,
    sample_grid,
    sample_cloud,
    train,
    summarize,
)
"""Stages that fuse it."""

STAGES = CHECKS + FUSION


def run_stages(step: Step, stages: Sequence[Stage]) -> Step:
    """Runs stages, each in a named scope of its own."""
    for stage in stages:
        with jax.named_scope(stage.__name__):
            step = stage(step)
    return step


def is_accepted(step: Step) -> jax.Array:
    """Returns whether the checked cloud is to be fused, () bool."""
    refused = Flag.BAD_POSE | Flag.EMPTY_CLOUD | Flag.OUT_OF_RANGE | Flag.BAD_ARGUMENT
    refused |= Flag.NOT_REGISTERED
    most = step.config.most_refusals
    # Random points are refused however often they come: no pose explains them.
    patient = (step.state.report.refused_in_row < most) | (step.novelty.noise & (most > 0))
    return ~_has(step, refused) & ~(_has(step, Flag.INCONSISTENT_CLOUD) & patient)


def refuse(state: MapState, step: Step) -> MapState:
    """Returns the map as it was, with the flags of a checked cloud that is not fused."""
    report = state.report
    inconsistent = _has(step, Flag.INCONSISTENT_CLOUD)
    return state.replace(
        report=report.replace(
            refused_in_row=report.refused_in_row + inconsistent.astype(jnp.int32),
            update_flags=step.flags,
            flags=report.flags | step.flags,
        )
    )


def _flag(step: Step, flag: Flag, raised: jax.Array) -> Step:
    return step._replace(flags=step.flags | jnp.where(raised, flag, 0).astype(jnp.uint32))


def _has(step: Step, flags: Flag) -> jax.Array:
    """Returns whether this update has one of some flags."""
    return (step.flags & flags) > 0


def _with_patches(
    window: evidence.EvidenceWindow, patched: evidence.EvidenceWindow
) -> evidence.EvidenceWindow:
    """Gives a window the patches of another one, which carry the derivatives.

    The stages between have changed its counts and weights alone.
    """
    return window._replace(mean=patched.mean, axes=patched.axes)


def _with_grid(step: Step, grid: Grid) -> Step:
    return step._replace(state=step.state.replace(grid=grid))
