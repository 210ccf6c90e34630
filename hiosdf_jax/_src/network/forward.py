"""The SIREN's value and gradient, written out for speed.

Autodiff of the plain network gives the same numbers. Here one range reduction gives the sine and
the cosine of a layer, and the gradient shares the forward evaluation with the value. A SIREN is
limited by memory traffic, so on a GPU activations are float16. Sines, cosines times omega_0 and
phases of a few radians suit float16, which has eight times the precision of bfloat16 at the same
speed. Weights and accumulation are float32.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.network.fast_sine import sine_and_cosine
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.modes import plain

Layer = tuple[jax.Array, jax.Array]  # kernel, bias


def stored_dtype() -> Any:
    """Returns the type of stored activations on the default device."""
    return jnp.float32 if jax.default_backend() == "cpu" else jnp.float16


def layers_of(params: Any) -> list[Layer]:
    """Lists the layers of a `Siren`'s parameters, from input to output."""
    dense = params["params"]
    return [(dense[f"Dense_{k}"]["kernel"], dense[f"Dense_{k}"]["bias"]) for k in range(len(dense))]


def value(frequency: float, params: Any, points: jax.Array) -> jax.Array:
    """Evaluates the network.

    Args:
        frequency: omega_0.
        params: The weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        (...) m. Differentiable in reverse mode.
    """
    layers = layers_of(params)
    sines, _ = _forward(frequency, layers, points)
    return _output(layers[-1], sines)


def value_and_gradient(
    frequency: float, params: Any, points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates the network and its gradient by the points.

    Args:
        frequency: omega_0.
        params: The weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        The values (...) m and their gradients (..., 3). Differentiable in reverse mode.
    """
    layers = layers_of(params)
    sines, cosines = _forward(frequency, layers, points)
    kernel, _ = layers[-1]
    back = kernel[:, 0] * cosines[-1]
    for (kernel, _), cosine in zip(layers[-2:0:-1], cosines[-2::-1], strict=True):
        back = _product(back, kernel.T) * cosine
    kernel, _ = layers[0]
    return _output(layers[-1], sines), _product_exact(back, kernel.T)


def _forward(
    frequency: float, layers: list[Layer], points: jax.Array
) -> tuple[jax.Array, list[jax.Array]]:
    """Computes the sines of the last hidden layer and every layer's cosines times omega_0."""
    kernel, bias = layers[0]
    sines, cosines = _activate(frequency, _add_bias(_product_exact(points, kernel), bias))
    every = [cosines]
    for kernel, bias in layers[1:-1]:
        sines, cosines = _activate(frequency, _add_bias(_product(sines, kernel), bias))
        every.append(cosines)
    return sines, every


def _output(layer: Layer, sines: jax.Array) -> jax.Array:
    kernel, bias = layer
    return _product_exact(sines.astype(jnp.float32), kernel)[..., 0] + bias[0]


def _product_exact(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """(..., K) times (K, M), for a small K or M, in float32.

    Meters need all of float32: written out, no tensor core of a GPU rounds them.
    """
    if jax.default_backend() == "cpu":
        return x @ kernel
    if kernel.shape[0] <= kernel.shape[1]:
        first, *rest = (x[..., k, None] * kernel[k] for k in range(kernel.shape[0]))
        return sum(rest, first)
    columns = [jnp.sum(x * kernel[:, k], axis=-1) for k in range(kernel.shape[1])]
    return jnp.stack(columns, axis=-1)


def _add_bias(x: jax.Array, bias: jax.Array) -> jax.Array:
    return _add_bias_on_cpu(x, bias) if jax.default_backend() == "cpu" else x + bias


# Adding up the rows of the bias's gradient is a fifth of a training step on a CPU. As a product it
# is free.
@jax.custom_vjp
def _add_bias_on_cpu(x: jax.Array, bias: jax.Array) -> jax.Array:
    return x + bias


def _add_bias_forward(x: jax.Array, bias: jax.Array) -> tuple[jax.Array, None]:
    return x + bias, None


def _add_bias_backward(residual: None, upstream: jax.Array) -> tuple[jax.Array, jax.Array]:
    rows = upstream.reshape(-1, upstream.shape[-1])
    return upstream, (jnp.ones((1, rows.shape[0]), rows.dtype) @ rows)[0]


_add_bias_on_cpu.defvjp(plain(_add_bias_forward), plain(_add_bias_backward))


@jax.custom_vjp
def _product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """(..., K) times (K, M)."""
    return _dot(x, kernel, stored_dtype())


def _product_forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, Any]:
    return _product(x, kernel), (x.astype(stored_dtype()), kernel, jnp.zeros((), x.dtype))


def _product_backward(residual: Any, upstream: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel, like = residual
    upstream = upstream.astype(stored_dtype())
    rows = upstream.reshape(-1, upstream.shape[-1])
    by_kernel = _dot(x.reshape(-1, x.shape[-1]).T, rows, jnp.float32)
    return _dot(upstream, kernel.T, stored_dtype()).astype(like.dtype), by_kernel


_product.defvjp(plain(_product_forward), plain(_product_backward))


def _dot(x: jax.Array, kernel: jax.Array, dtype: Any) -> jax.Array:
    contract = (((x.ndim - 1,), (0,)), ((), ()))
    factors = x.astype(stored_dtype()), kernel.astype(stored_dtype())
    return jax.lax.dot_general(*factors, contract, preferred_element_type=dtype)


@jax.custom_vjp
def _activation(frequency: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    sine, cosine = sine_and_cosine(frequency * z)
    result = sine.astype(stored_dtype()), (frequency * cosine).astype(stored_dtype())
    return compute_once(result)


def _activation_forward(frequency: jax.Array, z: jax.Array) -> tuple[Any, Any]:
    sine, cosine = _activation(frequency, z)
    return (sine, cosine), (frequency, sine, cosine)


def _activation_backward(residual: Any, upstream: Any) -> tuple[None, jax.Array]:
    frequency, sine, cosine = residual
    by_sine, by_cosine = (u.astype(jnp.float32) for u in upstream)
    return None, by_sine * cosine - frequency**2 * by_cosine * sine


_activation.defvjp(plain(_activation_forward), plain(_activation_backward))


def _activate(frequency: float, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes sin(omega_0 z) and its derivative by z."""
    return _activation(jnp.float32(frequency), z)
