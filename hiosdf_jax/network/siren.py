"""The SIREN (paper, section IV-A): layers of sin(omega_0 (W x + b)), and a linear output."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from hiosdf_jax.config import Config
from hiosdf_jax.network.sine import sine


class Siren(nn.Module):
    """A fully connected network with sine activations.

    Attributes:
        width: Of the input layer and of each hidden layer.
        layers: Hidden layers after the input layer.
        frequency: omega_0.
    """

    width: int
    layers: int
    frequency: float

    @nn.compact
    def __call__(self, points: jax.Array) -> jax.Array:
        """Maps (..., 3) points to (...) values."""
        x = points
        for _ in range(self.layers + 1):
            x = sine(self.frequency * self._dense(self.width, x))
        return self._dense(1, x)[..., 0]

    def _dense(self, width: int, x: jax.Array) -> jax.Array:
        bound = (6 / x.shape[-1]) ** 0.5 / self.frequency

        def uniform(key: jax.Array, shape: Any, dtype: Any = jnp.float32) -> jax.Array:
            return jax.random.uniform(key, shape, dtype, -bound, bound)

        return nn.Dense(width, kernel_init=uniform, bias_init=uniform)(x)


def siren(config: Config) -> Siren:
    """The network that a configuration describes."""
    return Siren(config.hidden_width, config.hidden_layers, config.frequency)


def init_params(config: Config, key: jax.Array) -> Any:
    """Draws the network's first weights from U(-sqrt(6 / n) / omega_0, sqrt(6 / n) / omega_0)."""
    return siren(config).init(key, jnp.zeros((1, 3)))


def predict(config: Config, params: Any, points: jax.Array) -> jax.Array:
    """Evaluates the network.

    Args:
        config: The map's configuration.
        params: Its weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        (...) m.
    """
    return jnp.asarray(siren(config).apply(params, points))


def predict_with_gradient(
    config: Config, params: Any, points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates the network and its gradient by one backward pass for the whole batch.

    Args:
        config: The map's configuration.
        params: Its weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        The values (...) m and their gradients (..., 3).
    """
    value, pull = jax.vjp(lambda x: predict(config, params, x), points)
    return value, pull(jnp.ones_like(value))[0]


def shift_output(config: Config, params: Any, amount: jax.Array) -> Any:
    """Adds an amount to the network's output.

    Args:
        config: The map's configuration.
        params: Its weights.
        amount: () m.

    Returns:
        The weights with a shifted output bias.
    """
    last = f"Dense_{config.hidden_layers + 1}"
    layers = params["params"]
    layer = layers[last] | {"bias": layers[last]["bias"] + amount}
    return params | {"params": layers | {last: layer}}
