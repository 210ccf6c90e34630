"""The training loss (paper, section IV-D): equation 4 over all samples, equation 5 over some."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.network import forward
from hiosdf_jax._src.samples.draw import Samples

# Keeps the derivative of the gradient's length finite where the gradient is 0.
LEAST_SQUARE = 1e-12


class Losses(NamedTuple):
    """The two parts of the loss, before their weights.

    Attributes:
        sdf: Mean |f - s|, () m (equation 4).
        eikonal: Mean | |grad f| - 1 |, () (equation 5).
    """

    sdf: jax.Array
    eikonal: jax.Array


def sums(config: Config, params: Any, points: jax.Array, samples: Samples) -> Losses:
    """Sums the losses over samples; the Eikonal loss takes the first group of them.

    Args:
        config: The map's configuration.
        params: The network's weights.
        points: (N, 3) the samples' points relative to the network's origin, m.
        samples: The samples.

    Returns:
        The losses times the sums of `weights`.
    """
    sloped = sloped_rows(config, samples)
    value, gradient = forward.value_and_gradient(config.frequency, params, points[:sloped])
    if sloped < points.shape[0]:
        others = forward.value(config.frequency, params, points[sloped:])
        value = jnp.concatenate([value, others])
    slope = slope_of(gradient)
    return Losses(
        jnp.sum(jnp.abs(value - samples.sdf) * samples.weight),
        jnp.sum(jnp.abs(slope - 1) * samples.weight[:sloped]),
    )


def slope_of(gradient: jax.Array, axis: int = -1) -> jax.Array:
    """Computes the length of gradients; its derivative is finite everywhere."""
    return jnp.sqrt(jnp.sum(gradient**2, axis=axis) + LEAST_SQUARE)


def weights(config: Config, samples: Samples) -> Losses:
    """Sums the weights of all (..., N) samples, and of those whose slope counts."""
    sloped = samples.weight[..., : sloped_rows(config, samples)]
    return Losses(jnp.sum(samples.weight), jnp.sum(sloped))


def sloped_rows(config: Config, samples: Samples) -> int:
    """Returns the number of (..., N) samples whose slopes count: the first ones."""
    return -(-samples.weight.shape[-1] // config.eikonal_every)


def means(total: Losses, weight: Losses) -> Losses:
    """Divides the sums of losses by those of `weights`."""
    return jax.tree.map(lambda part, whole: part / jnp.maximum(whole, 1), total, weight)


def count(weight: Losses) -> jax.Array:
    """Returns the sum of all samples' weights; at least 1."""
    return jnp.maximum(weight.sdf, 1)
