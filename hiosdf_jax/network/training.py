"""The fit of the network to samples (paper, section IV-D)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hiosdf_jax.config import Config
from hiosdf_jax.network import passes, siren
from hiosdf_jax.samples import Samples
from hiosdf_jax.state import Network


class Losses(NamedTuple):
    """The two parts of the loss, before their weights.

    Attributes:
        sdf: Mean |f - s|, () m (equation 4).
        eikonal: Mean | |grad f| - 1 |, () (equation 5).
    """

    sdf: jax.Array
    eikonal: jax.Array


def init_network(config: Config, key: jax.Array) -> Network:
    """Makes an untrained network whose zero is the middle of the bounds.

    Args:
        config: The map's configuration.
        key: Source of randomness.

    Returns:
        The network.
    """
    params = siren.init_params(config, key)
    return Network(
        params=params,
        served=jax.tree.map(jnp.copy, params),
        optimizer=_optimizer(config).init(params),
        origin_world=jnp.mean(jnp.asarray(config.bounds, jnp.float32), axis=0),
    )


def losses(config: Config, params: Any, points: jax.Array, samples: Samples) -> Losses:
    """Computes the losses over samples, the Eikonal one over the first of them.

    Args:
        config: The map's configuration.
        params: The network's weights.
        points: (N, 3) the samples' points relative to the network's origin, m.
        samples: The samples, in random order but for that.

    Returns:
        Their means over the samples with weight.
    """
    sloped = -(-points.shape[0] // config.eikonal_every)
    value, gradient = passes.value_and_gradient(config.frequency, params, points[:sloped])
    if sloped < points.shape[0]:
        others = passes.value(config.frequency, params, points[sloped:])
        value = jnp.concatenate([value, others])
    # Not a safe norm: where the gradient is 0 its direction is undefined anyway, and 1e-12 is
    # enough to keep the derivative finite.
    slope = jnp.sqrt(jnp.sum(gradient**2, axis=-1) + 1e-12)
    return Losses(
        _mean(jnp.abs(value - samples.sdf), samples.weight),
        _mean(jnp.abs(slope - 1), samples.weight[:sloped]),
    )


def train(
    config: Config,
    network: Network,
    samples: Samples,
    epochs: jax.Array,
    average: jax.Array,
    key: jax.Array,
) -> tuple[Network, Losses, jax.Array]:
    """Continues training, and averages the weights that are served.

    Args:
        config: The map's configuration.
        network: The network so far.
        samples: What to fit.
        epochs: () int32 times to go through the samples.
        average: () share of the old weights in those that are served.
        key: Source of randomness, for the order of the samples.

    Returns:
        The network, the mean losses of the last epoch, and whether all is finite; if not, the
        network is as it was.
    """
    optimizer = _optimizer(config)
    batches = _split(config, samples, key)

    def objective(params: Any, batch: Samples) -> tuple[jax.Array, Losses]:
        points = batch.points_world - network.origin_world
        parts = losses(config, params, points, batch)
        loss = config.sdf_weight * parts.sdf + config.eikonal_weight * parts.eikonal
        # A sum instead of a mean: single samples' shares of it would vanish in float16.
        return loss * _count(batch), parts

    def step(carry: tuple[Any, Any], batch: Samples) -> tuple[tuple[Any, Any], Losses]:
        params, state = carry
        gradients, parts = jax.grad(objective, has_aux=True)(params, batch)
        gradients = jax.tree.map(lambda gradient: gradient / _count(batch), gradients)
        updates, state = optimizer.update(gradients, state, params)
        return (optax.apply_updates(params, updates), state), parts

    def epoch(_: jax.Array, carry: tuple[Any, Any, Losses]) -> tuple[Any, Any, Losses]:
        (params, state), parts = jax.lax.scan(step, carry[:2], batches)
        return params, state, jax.tree.map(jnp.mean, parts)

    start = (network.params, network.optimizer, Losses(jnp.float32(0), jnp.float32(0)))
    params, state, parts = jax.lax.fori_loop(0, epochs, epoch, start)

    finite = jnp.isfinite(parts.sdf + parts.eikonal) & jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(params)])
    )
    served = jax.tree.map(
        lambda old, new: average * old + (1 - average) * new, network.served, params
    )
    points = samples.points_world - network.origin_world
    residual = siren.predict(config, served, points) - samples.sdf
    served = siren.shift_output(config, served, -_median(residual, samples.weight))
    trained = network.replace(params=params, served=served, optimizer=state)
    kept = jax.tree.map(lambda new, old: jnp.where(finite, new, old), trained, network)
    return kept, parts, finite


def _split(config: Config, samples: Samples, key: jax.Array) -> Samples:
    """Shuffles samples into (batches, size) parts; what does not fill a part is left out.

    A single part needs no chance: one sample in `eikonal_every` comes first.
    """
    count = samples.sdf.shape[0]
    size = count // config.batches
    if config.batches == 1:
        order = np.argsort(np.arange(count) % config.eikonal_every > 0, kind="stable")
    else:
        order = jax.random.permutation(key, count)[: size * config.batches]
    return jax.tree.map(
        lambda array: array[order].reshape(config.batches, size, *array.shape[1:]), samples
    )


def _median(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Median of the values with weight; 0 if there are none."""
    median = jnp.nanmedian(jnp.where(weight > 0, values, jnp.nan))
    return jnp.where(jnp.any(weight > 0), median, 0)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return optax.adamw(config.learning_rate, weight_decay=config.weight_decay)


def _count(samples: Samples) -> jax.Array:
    return jnp.maximum(jnp.sum(samples.weight), 1)


def _mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    return jnp.sum(values * weight) / jnp.maximum(jnp.sum(weight), 1)
