"""The stages of an update, in order.

Each stage maps a `Step` to a `Step` and replaces some of its parts. `run_stages` runs the list, and
a profiler shows each stage under its name. The speed benchmark times the same list.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import carving, distance, evidence, frontier, patches, rays, windows
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.mapping import calibration
from hiosdf_jax._src.network import training
from hiosdf_jax._src.samples import from_cloud, from_grid
from hiosdf_jax._src.samples.draw import Samples, concatenate
from hiosdf_jax._src.state import Flag, Grid, MapState, Report, field_of

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
        rays: The cloud in the world frame.
        window: The evidence around the sensor, float32.
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
    rays: Rays = _LATER
    window: evidence.EvidenceWindow = _LATER
    samples: Samples = _LATER
    losses: training.Losses = _LATER
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
) -> Step:
    """Starts an update: draws its keys and stores the next one in the map."""
    key, grid_key, cloud_key, order_key, bound_key = jax.random.split(state.key, 5)
    keys = Keys(bound=bound_key, grid=grid_key, cloud=cloud_key, order=order_key)
    return Step(state.replace(key=key), cloud, finite, pose, keys, robot, noise)


def place_cloud(step: Step) -> Step:
    """Transforms the cloud to the world frame, without the returns on the robot."""
    placed = rays.place_cloud(step.config, step.cloud, step.finite, step.pose)
    if step.robot is not None:
        placed = rays.remove_robot(placed, *step.robot)
    return step._replace(rays=placed)


def calibrate_bound(step: Step) -> Step:
    """Compares the map so far with the cloud, for the lower bound of the distance."""
    optimism = calibration.calibrate_bound(field_of(step.state), step.rays, step.keys.bound)
    return step._replace(state=step.state.replace(optimism=optimism))


def read_window(step: Step) -> Step:
    """Reads the evidence within reach of the sensor."""
    window = evidence.read_window(step.config, step.state.grid.evidence, step.rays)
    return step._replace(window=window)


def fuse_hits(step: Step) -> Step:
    """Merges the returns into surface patches (IV-B)."""
    return step._replace(window=patches.fuse_hits(step.config, step.window, step.rays, step.noise))


def trace_rays(step: Step) -> Step:
    """Counts the rays through free voxels and marks hidden ones (IV-B)."""
    return step._replace(window=carving.trace_rays(step.config, step.window, step.rays))


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
    box = windows.box_of_rays(step.rays)
    return _with_grid(step, distance.update_distances(step.config, step.state.grid, box))


def update_frontier(step: Step) -> Step:
    """Computes every voxel's distance to unseen space."""
    box = windows.box_of_rays(step.rays)
    return _with_grid(step, frontier.update_frontier(step.config, step.state.grid, box))


def sample_grid(step: Step) -> Step:
    """Draws training samples from the grid (IV-B)."""
    return step._replace(
        samples=from_grid.sample_grid(step.config, step.state.grid, step.keys.grid)
    )


def sample_cloud(step: Step) -> Step:
    """Adds training samples from the newest cloud: the local SDF (IV-C)."""
    local = from_cloud.sample_cloud(step.config, step.rays, step.keys.cloud)
    return step._replace(samples=concatenate(step.samples, local))


def train(step: Step) -> Step:
    """Fits the network to the samples (IV-D)."""
    extra_epochs, average = training.schedule(step.config, step.state.updates)
    network, losses, trained = training.train(
        step.config, step.state.network, step.samples, extra_epochs, average, step.keys.order
    )
    state = step.state.replace(network=network)
    return step._replace(state=state, losses=losses, trained=trained)


def summarize(step: Step) -> Step:
    """Counts the update and writes its report."""
    state, ends, inside = step.state, step.rays.ends, step.rays.inside
    outside = ends & ~inside
    flags = (
        state.report.flags
        | jnp.where(jnp.any(outside), Flag.POINTS_OUTSIDE, 0).astype(jnp.uint32)
        | jnp.where(step.trained, 0, Flag.TRAINING_FAILED).astype(jnp.uint32)
    )

    def count(rows: jax.Array) -> jax.Array:
        return jnp.sum(rows, dtype=jnp.int32)

    report = Report(
        points_used=count(ends & inside),
        points_outside=count(outside),
        points_out_of_range=count(step.finite & ~ends),
        points_invalid=count(~step.finite),
        sdf_loss=step.losses.sdf,
        eikonal_loss=step.losses.eikonal,
        flags=flags,
    )
    return step._replace(state=state.replace(updates=state.updates + 1, report=report))


STAGES: tuple[Stage, ...] = (
    place_cloud,
    calibrate_bound,
    read_window,
    fuse_hits,
    trace_rays,
    fade_evidence,
    write_window,
    update_distances,
    update_frontier,
    sample_grid,
    sample_cloud,
    train,
    summarize,
)


def run_stages(step: Step) -> Step:
    """Runs all stages, each in a named scope of its own."""
    for stage in STAGES:
        with jax.named_scope(stage.__name__):
            step = stage(step)
    return step


def _with_grid(step: Step, grid: Grid) -> Step:
    return step._replace(state=step.state.replace(grid=grid))
