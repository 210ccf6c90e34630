"""Tasks that time training and the paper's network, beside PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import hiosdf_jax as hio
from benchmarks.speed import baselines, limits
from benchmarks.speed.rows import Measured, time_ms
from benchmarks.variants import VARIANTS
from hiosdf_jax._src.command.timing import points_in
from hiosdf_jax._src.config import Bounds
from hiosdf_jax._src.network import training
from hiosdf_jax._src.samples.draw import Samples
from hiosdf_jax._src.state.pytrees import field_of


def train(label: str, config: hio.Config, machine: limits.Limits, seconds: float) -> Measured:
    """Times the training of a configuration.

    Args:
        label: Name of the configuration.
        config: The configuration.
        machine: The machine's rates.
        seconds: How long to time it.

    Returns:
        A row in ms, beside PyTorch's training of the paper's network.
    """
    spread = time_ms(_trainer(config), *_training_arguments(config), seconds=seconds)
    work = limits.training_work(config)
    return Measured([limits.row(machine, f"training, {label}", spread, work, "training")])


def train_paper(
    bounds: Bounds, overrides: dict[str, Any], machine: limits.Limits, seconds: float
) -> Measured:
    """Times the paper's training with the slopes of all samples and of half of them.

    Args:
        bounds: The stream's bounds.
        overrides: Fields of the configuration to change.
        machine: The machine's rates.
        seconds: How long to time each.

    Returns:
        Rows in ms, and PyTorch's training, with all slopes, as their baseline.
    """
    rows, beside = [], {}
    for every in (1, 2):
        config = hio.Config.paper(bounds, **(overrides | {"eikonal_every": every}))
        arguments = _training_arguments(config)
        network, samples, *_ = arguments
        spread = time_ms(_trainer(config), *arguments, seconds=seconds)
        if every == 1:
            beside["training"] = baselines.training(config, network, samples, seconds)
        name = f"the paper's training, {config.epochs} epochs of {samples.sdf.size:,}"
        name += "" if every == 1 else f", slopes of 1 in {every}"
        work = limits.training_work(config)
        rows.append(limits.row(machine, name, spread, work, "training"))
    return Measured(rows, beside)


def query_paper(bounds: Bounds, count: int, machine: limits.Limits, seconds: float) -> Measured:
    """Times distances and gradients of the paper's network alone; its weights do not matter.

    Args:
        bounds: The stream's bounds.
        count: Points per query.
        machine: The machine's rates.
        seconds: How long to time it.

    Returns:
        A row in ms, and PyTorch's queries as its baseline.
    """
    config = hio.Config.paper(bounds)
    state = hio.init(config, jax.random.key(0))
    points = points_in(config, count)
    spread = time_ms(VARIANTS["network"], field_of(state), points, seconds=seconds)
    relative = points - state.network.origin_world
    beside = baselines.network_query(config, state.network, relative, seconds)
    work = limits.network_query_work(config, count)
    name = f"sdf and gradient of {count:,}, the paper's network"
    row = limits.row(machine, name, spread, work, "network query")
    return Measured([row], {"network query": beside})


def _trainer(config: hio.Config) -> Callable[..., Any]:
    return jax.jit(lambda *arguments: training.train(config, *arguments))


def _training_arguments(config: hio.Config) -> tuple[Any, ...]:
    """An untrained network and distances to a ball, which take as long as any others."""
    network = training.init_network(config, jax.random.key(0))
    count = config.near_samples + config.far_samples
    count += config.local_points * config.local_ray_samples
    points = points_in(config, count)
    radius = jnp.linalg.norm(points - network.origin_world, axis=-1)
    samples = Samples(points, radius - 1, jnp.ones(count))
    extra_epochs = jnp.int32(config.epochs - training.least_epochs(config))
    return network, samples, extra_epochs, jnp.float32(0.9), jax.random.key(1)
