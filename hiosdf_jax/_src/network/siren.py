"""The SIREN (paper, section IV-A): layers of sin(omega_0 (W x + b)), and a linear output."""

from __future__ import annotations

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.network import evaluation
from hiosdf_jax._src.network.fast_sine import sine
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.tangents import all_zero, instantiate


class Siren(nn.Module):
    """A fully connected network with sine activations.

    Attributes:
        width: Width of the input layer and of each hidden layer.
        layers: Number of hidden layers after the input layer.
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


def network_of(config: Config) -> Siren:
    """Makes the network that a configuration describes."""
    return Siren(config.hidden_width, config.hidden_layers, config.frequency)


def init_params(config: Config, key: jax.Array) -> Any:
    """Draws initial weights from U(-sqrt(6 / n) / omega_0, sqrt(6 / n) / omega_0)."""
    return _init_params(network_of(config), key)


# Compiled as a whole: flax evaluates the network as well, by some 50 programs of their own.
@functools.partial(jax.jit, static_argnums=0)
def _init_params(network: Siren, key: jax.Array) -> Any:
    return network.init(key, jnp.zeros((1, 3), jnp.float32))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def predict(config: Config, params: Any, points: jax.Array) -> jax.Array:
    """Evaluates the network.

    Args:
        config: The map's configuration.
        params: Its weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        (...) m. Differentiable any number of times.
    """
    return evaluation.value(config.frequency, params, points)


@functools.partial(predict.defjvp, symbolic_zeros=True)
@plain
def _predict_jvp(config: Config, primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    (params, points), (by_params, by_points) = primals, tangents
    if not all_zero(by_params):
        return jax.jvp(network_of(config).apply, primals, instantiate(primals, tangents))
    value, gradient = predict_with_gradient(config, params, points)
    return value, jnp.sum(gradient * instantiate(points, by_points), axis=-1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def predict_with_gradient(
    config: Config, params: Any, points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates the network and its gradient by one reverse-mode evaluation for the whole batch.

    Args:
        config: The map's configuration.
        params: Its weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        The values (...) m and their gradients (..., 3). Differentiable any number of times.
    """
    return evaluation.value_and_gradient(config.frequency, params, points)


@predict_with_gradient.defjvp
@plain
def _predict_with_gradient_jvp(config: Config, primals: Any, tangents: Any) -> Any:
    def by_autodiff(params: Any, points: jax.Array) -> tuple[jax.Array, jax.Array]:
        return value_and_gradient(
            lambda x: jnp.asarray(network_of(config).apply(params, x)), points
        )

    return jax.jvp(by_autodiff, primals, tangents)


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
