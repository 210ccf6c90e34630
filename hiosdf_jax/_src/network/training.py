"""Fits the network to samples (paper, section IV-D)."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.network import derivatives, forward, loss, siren, tiles
from hiosdf_jax._src.network.loss import Losses
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.tiles import map_tiles
from hiosdf_jax._src.samples.draw import Samples
from hiosdf_jax._src.state.pytrees import Network

# Where at least this share of the surface is new or has vanished, the old weights are those of
# another world: the average then keeps at most this share of them.
_CHANGED_WORLD = 0.02
_CHANGED_AVERAGE = 0.5


def init_network(config: Config, key: jax.Array) -> Network:
    """Makes an untrained network with its origin in the middle of the bounds.

    Args:
        config: The map's configuration.
        key: Source of randomness.

    Returns:
        The network.
    """
    params = siren.init_params(config, key)
    return Network(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        optimizer=_optimizer(config).init(params),
        origin_world=jnp.mean(jnp.asarray(config.bounds, jnp.float32), axis=0),
    )


def least_epochs(config: Config) -> int:
    """Returns the number of epochs that every update makes, during warm-up or not."""
    return min(config.epochs, config.warmup_epochs)


def schedule(config: Config, updates: jax.Array, changed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes how an update trains the network.

    Args:
        config: The map's configuration.
        updates: Number of earlier updates, () int32.
        changed: Share of the surface that the newest cloud saw appear or vanish, ().

    Returns:
        extra_epochs: Epochs beyond `least_epochs`, () int32.
        average: Share of the old weights in the average, (). Over the first updates it is a running
            mean, so that queries never use the untrained network. After a change it is smaller.
    """
    epochs = jnp.where(updates < config.warmup_updates, config.warmup_epochs, config.epochs)
    extra_epochs = epochs - least_epochs(config)
    most = jnp.where(changed >= _CHANGED_WORLD, _CHANGED_AVERAGE, 1.0)
    average = jnp.minimum(config.weight_average, updates / (updates + 1.0))
    return extra_epochs, jnp.minimum(average, most)


def train(
    config: Config,
    network: Network,
    samples: Samples,
    extra_epochs: jax.Array,
    average: jax.Array,
    key: jax.Array,
) -> tuple[Network, Losses, jax.Array]:
    """Continues training, and updates the average weights.

    Args:
        config: The map's configuration.
        network: The network so far.
        samples: The samples to fit.
        extra_epochs: Epochs beyond `least_epochs`, () int32.
        average: Share of the old weights in the average, ().
        key: Source of randomness, for the order of the samples.

    Returns:
        network: The trained network; unchanged if training was not finite. An optimizer that was
            not finite before is then reset: otherwise no later training would be finite.
        parts: The mean losses of the last epoch.
        finite: Whether losses, weights and the optimizer are finite, () bool.
    """
    optimizer = _optimizer(config)
    batches = _split(config, samples, key)

    def step(carry: tuple[Any, Any], batch: Samples) -> tuple[tuple[Any, Any], Losses]:
        params, state = carry
        weights = loss.weights(config, batch)

        def add(total: tuple[Any, Losses], tile: Samples) -> tuple[tuple[Any, Losses], None]:
            points = tile.points_world - network.origin_world
            part = derivatives.loss_gradient(config, params, points, tile, weights)
            return jax.tree.map(jnp.add, total, part), None

        nothing = varying_like(jax.tree.map(jnp.zeros_like, (params, weights)), params, batch)
        (gradients, sums), _ = jax.lax.scan(add, nothing, batch)
        gradients = jax.tree.map(lambda gradient: gradient / loss.count(weights), gradients)
        updates, state = optimizer.update(gradients, state, params)
        return (optax.apply_updates(params, updates), state), loss.means(sums, weights)

    def epoch(number: jax.Array, carry: tuple[Any, Any, Losses]) -> tuple[Any, Any, Losses]:
        (params, state), parts = jax.lax.scan(step, carry[:2], _turn(config, batches, number))
        return params, state, jax.tree.map(jnp.mean, parts)

    start = (network.params, network.optimizer, Losses(jnp.float32(0), jnp.float32(0)))
    start = varying_like(start, network, batches, extra_epochs)
    least = least_epochs(config)
    if jax.default_backend() == "cpu":
        params, state, parts = jax.lax.fori_loop(0, least + extra_epochs, epoch, start)
    else:
        # A GPU waits for the host at each iteration of a loop of unknown length, and `update`
        # returns only after the last one.
        extra = jax.lax.fori_loop(0, extra_epochs, epoch, start)
        params, state, parts = jax.lax.fori_loop(
            0, least, lambda number, carry: epoch(extra_epochs + number, carry), extra
        )

    finite = _is_finite((parts, params, state))
    mean = jax.tree.map(
        lambda old, new: average * old + (1 - average) * new, network.average, params
    )
    points = samples.points_world - network.origin_world
    # By XLA: a kernel for one evaluation per update would take longer to compile than it saves.
    value = map_tiles(partial(forward.value, config.frequency, mean), points, tiles.LARGEST)
    residual = value - samples.sdf
    mean = siren.shift_output(config, mean, -_median(residual, samples.weight))
    trained = network.replace(params=params, average=mean, optimizer=state)
    usable, fresh = _is_finite(network.optimizer), optimizer.init(network.params)
    old = network.replace(
        optimizer=jax.tree.map(partial(jnp.where, usable), network.optimizer, fresh)
    )
    return jax.tree.map(partial(jnp.where, finite), trained, old), parts, finite


def _is_finite(tree: Any) -> jax.Array:
    """Returns whether all numbers of a tree are finite, () bool."""
    leaves = [leaf.astype(jnp.float32).ravel() for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.isfinite(jnp.concatenate(leaves)))  # one kernel instead of one per leaf


def _split(config: Config, samples: Samples, key: jax.Array) -> Samples:
    """Distributes samples to (batches, tiles, size); those that do not fill a batch are left out.

    The slopes of the `eikonal_every` groups of a tile count in turn. The groups are contiguous.
    """
    count = samples.sdf.shape[0]
    size = count // config.batches
    dealt = tiles.tile_index(size, config.eikonal_every)
    groups = np.arange(dealt.shape[1]) % config.eikonal_every
    dealt = dealt[:, np.argsort(groups, kind="stable")]
    order = _order(config, count, key)[: size * config.batches].reshape(config.batches, size)
    batches = jax.tree.map(lambda array: array[order[:, np.minimum(dealt, size - 1)]], samples)
    return batches._replace(weight=jnp.where(dealt < size, batches.weight, 0))


def _order(config: Config, count: int, key: jax.Array) -> jax.Array:
    """Shuffles samples for several batches or groups."""
    if config.batches > 1:
        return jnp.argsort(jax.random.bits(key, (count,), jnp.uint32))
    if config.eikonal_every > 1:
        # Every update draws new samples, so one order suffices. Their own order would
        # not do: there each n-th sample of a ray is at the same depth.
        return jnp.asarray(np.random.default_rng(0).permutation(count))
    return jnp.arange(count)


def _turn(config: Config, batches: Samples, epoch: jax.Array) -> Samples:
    """Rotates the groups of each tile by one per epoch; the slopes of the first group count.

    With the same group in all epochs of an update, the network would fit its slopes alone.
    """
    if config.eikonal_every == 1:
        return batches
    size, sloped = batches.weight.shape[2], loss.sloped_rows(config, batches)
    turns = size // math.gcd(size, sloped)  # the rotation has this period
    places = -(epoch % turns) * sloped
    return jax.tree.map(lambda array: jnp.roll(array, places, axis=2), batches)


def _median(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Computes the median of the values with weight; 0 if there are none."""
    counted = weight > 0
    # Integers in the order of the values: XLA on a CPU sorts them seven times as fast.
    bits = jax.lax.bitcast_convert_type(values.astype(jnp.float32), jnp.int32)
    last = np.int32(np.iinfo(np.int32).max)
    key = jnp.where(counted, jnp.where(bits < 0, bits ^ last, bits), last)
    count = jnp.sum(counted, dtype=jnp.int32)
    middle = jnp.sort(key)[jnp.stack([jnp.maximum(count - 1, 0) // 2, count // 2])]
    row = jnp.argmax(key == middle[:, None], axis=1)
    return jnp.where(count > 0, jnp.mean(values[row]), 0)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
