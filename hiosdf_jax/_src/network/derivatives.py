"""The gradient of the training loss: by one kernel on a Hopper GPU, else by XLA."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.network import evaluation, forward, loss
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.samples.draw import Samples

_WIDTH = 128  # wider networks do not fit; see `hopper_training`
_LEAST_ROWS = 8192  # fewer gain little, and the kernels take seconds to compile


def loss_gradient(
    config: Config, params: Any, points: jax.Array, samples: Samples, weights: loss.Losses
) -> tuple[Any, loss.Losses]:
    """Computes the gradient of the loss by the network's weights.

    Args:
        config: The map's configuration.
        params: The network's weights.
        points: (N, 3) the samples' points relative to the network's origin, m.
        samples: N samples of a batch.
        weights: The sums of the batch's weights, `loss.weights`.

    Returns:
        gradient: Gradient of the loss times `loss.count(weights)`, since a single sample's share of
            the mean would vanish in float16.
        sums: Sums of the losses, as from `loss.sums`.
    """
    arguments = (params, points, samples, weights)
    by_xla = functools.partial(_by_xla, config)
    fits = evaluation.has_kernel(params) and config.hidden_width == _WIDTH
    if not fits or points.shape[0] < _LEAST_ROWS:
        return by_xla(*arguments)
    return _chosen(config, by_xla)(*jax.lax.stop_gradient(arguments))


def _by_xla(
    config: Config, params: Any, points: jax.Array, samples: Samples, weights: loss.Losses
) -> tuple[Any, loss.Losses]:
    def objective(params: Any) -> tuple[jax.Array, loss.Losses]:
        sums = loss.sums(config, params, points, samples)
        parts = loss.means(sums, weights)
        total = config.sdf_weight * parts.sdf + config.eikonal_weight * parts.eikonal
        return total * loss.count(weights), sums

    return jax.grad(objective, has_aux=True)(params)


def _chosen(config: Config, by_xla: Any) -> Any:
    """Decides by the device when the program is compiled; several networks are left to XLA."""
    by_kernel = functools.partial(_by_kernel, config)

    @custom_vmap
    def choose(*arguments: Any) -> Any:
        return devices.choose(by_kernel, by_xla, evaluation.INTERPRET, *arguments)

    @choose.def_vmap
    @plain  # traced again when a caller batches it, in the caller's modes
    def _(size: int, batched: Any, *arguments: Any) -> Any:
        result = evaluation.batch_by_xla(by_xla, batched, arguments)
        return result, jax.tree.map(lambda _: True, result)

    return choose


def _by_kernel(
    config: Config, params: Any, points: jax.Array, samples: Samples, weights: loss.Losses
) -> tuple[Any, loss.Losses]:
    from hiosdf_jax._src.network import hopper_training  # needs a jax with GPU kernels

    network = evaluation.kernel_arguments(config.frequency, params)
    share = loss.count(weights) / jnp.maximum(weights.eikonal, 1)
    targets = jnp.stack(
        [
            samples.sdf - forward.layers_of(params)[-1][1][0],
            config.sdf_weight * samples.weight,
            config.eikonal_weight * share * samples.weight,
        ]
    )
    sloped = loss.sloped_rows(config, samples)
    result = None
    for rows, with_slopes in ((slice(sloped), True), (slice(sloped, None), False)):
        count = len(samples.weight[rows])
        if count == 0:
            continue
        padding = (0, -count % hopper_training.TILE)
        padded = jnp.pad(points[rows], (padding, (0, 0)))
        padded_targets = jnp.pad(targets[:, rows], ((0, 0), padding))
        factors = hopper_training.factors(
            padded,
            padded_targets,
            *network,
            with_slopes=with_slopes,
            multiprocessors=evaluation.multiprocessors(),
            interpret=evaluation.INTERPRET,
        )
        weight = jnp.pad(samples.weight[rows], padding)
        part = _gradient_and_sums(config, padded, padded_targets, weight, factors)
        result = part if result is None else jax.tree.map(jnp.add, result, part)
    return result


def _gradient_and_sums(
    config: Config, points: jax.Array, targets: jax.Array, weight: jax.Array, factors: Any
) -> tuple[Any, loss.Losses]:
    """Computes gradient and sums of `loss_gradient` from `hopper_training.Factors`."""
    wanted, sdf, eikonal = targets
    hidden = jnp.einsum(
        "lpnd,lpne->lde", factors.inputs, factors.angles, preferred_element_type=jnp.float32
    )
    biases = jnp.sum(factors.angles[:, 0], axis=1, dtype=jnp.float32)
    by_angle = factors.first[0].astype(jnp.float32)
    error = factors.value - wanted
    by_value = jnp.where(error < 0, -sdf, sdf)
    # Meters need all of float32: written out, no tensor core rounds them.
    by_rows = [points[:, axis, None] * by_angle for axis in range(3)]
    by_output = by_value[:, None] * factors.last[0].astype(jnp.float32)
    slope_error = jnp.zeros_like(error)
    with_slopes = factors.last.shape[0] > 1
    if with_slopes:
        slope = loss.slope_of(factors.gradient, axis=0)
        slope_error = jnp.abs(slope - 1)
        by_gradient = jnp.where(slope < 1, -eikonal, eikonal) / slope * factors.gradient
        back = factors.first[1].astype(jnp.float32)
        by_rows = [row + by_gradient[axis, :, None] * back for axis, row in enumerate(by_rows)]
        by_output += factors.last[1].astype(jnp.float32)
    arrays = [*by_rows, by_angle, by_output]
    # Per epoch on an H100: with slopes 20 us stacked, 32 one by one; without them 38 and 28.
    if with_slopes:
        *first, first_bias, last = jnp.sum(jnp.stack(arrays), axis=1)
    else:
        *first, first_bias, last = (jnp.sum(array, axis=0) for array in arrays)
    scalars = jnp.stack([by_value, jnp.abs(error) * weight, slope_error * weight])
    last_bias, sdf_sum, eikonal_sum = jnp.sum(scalars, axis=1)
    # The kernel's weights, but for the last layer's, are multiplied by omega_0.
    kernels = [config.frequency * kernel for kernel in (jnp.stack(first), *hidden)]
    by_bias = [config.frequency * bias for bias in (first_bias, *biases)]
    kernels.append(last[:, None])
    by_bias.append(last_bias[None])
    layers = zip(kernels, by_bias, strict=True)
    gradient = {f"Dense_{k}": {"kernel": w, "bias": b} for k, (w, b) in enumerate(layers)}
    return {"params": gradient}, loss.Losses(sdf_sum, eikonal_sum)
