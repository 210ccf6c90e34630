"""Evaluates a SIREN at many points: by one kernel on a Hopper GPU, else by XLA, tile by tile.

`jax.vmap` over points makes more rows of one evaluation, so that a planner which is written for one
point is as fast as a batch.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from hiosdf_jax._src.network import forward
from hiosdf_jax._src.network.tiles import LARGEST
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.tiles import map_tiles

_WIDTHS = (128, 256)
_MOST_LAYERS = 8  # more biases than that do not fit into shared memory
_LEAST_ROWS = 8192  # fewer gain little, and the kernel takes seconds to compile

INTERPRET: Any = None  # the tests' way to run the kernel on a CPU


def value(frequency: float, params: Any, points: jax.Array) -> jax.Array:
    """Evaluates the network; see `forward.value`.

    Args:
        frequency: omega_0.
        params: The weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        (...) m. Without a derivative in reverse mode.
    """
    function = _chosen_value if has_kernel(params) else _value
    return function(jnp.float32(frequency), params, points)


def value_and_gradient(
    frequency: float, params: Any, points: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evaluates the network and its gradient by the points; see `forward.value_and_gradient`.

    Args:
        frequency: omega_0.
        params: The weights.
        points: (..., 3) m, relative to the network's origin.

    Returns:
        The values (...) m and their gradients (..., 3). Without a derivative in reverse mode.
    """
    function = _chosen_value_and_gradient if has_kernel(params) else _value_and_gradient
    return function(jnp.float32(frequency), params, points)


def has_kernel(params: Any) -> bool:
    """Returns whether a network has a shape for the kernels, and the device is one for them."""
    layers = forward.layers_of(params)
    widths = {kernel.shape[1] for kernel, _ in layers[:-1]}
    fits = len(widths) == 1 and widths <= set(_WIDTHS) and 3 <= len(layers) <= _MOST_LAYERS + 2
    return fits and devices.has_kernels()


def _value_by_xla(frequency: Any, params: Any, points: jax.Array) -> jax.Array:
    return map_tiles(lambda rows: forward.value(frequency, params, rows), points, LARGEST)


def _value_and_gradient_by_xla(frequency: Any, params: Any, points: jax.Array) -> Any:
    return map_tiles(
        lambda rows: forward.value_and_gradient(frequency, params, rows), points, LARGEST
    )


def _choose_value(frequency: jax.Array, params: Any, points: jax.Array) -> jax.Array:
    def by_kernel(*arguments: Any) -> jax.Array:
        return _by_kernel(*arguments, with_gradient=False)[0]

    return _choose(by_kernel, _value_by_xla, frequency, params, points)


def _choose_value_and_gradient(frequency: jax.Array, params: Any, points: jax.Array) -> Any:
    by_kernel = functools.partial(_by_kernel, with_gradient=True)
    return _choose(by_kernel, _value_and_gradient_by_xla, frequency, params, points)


def _choose(by_kernel: Any, by_xla: Any, *arguments: Any) -> Any:
    """Decides by the number of points now, and by the device when the program is compiled."""
    points = arguments[-1]
    if points.size < 3 * _LEAST_ROWS:
        return by_xla(*arguments)
    return devices.choose(by_kernel, by_xla, INTERPRET, *arguments)


def batch_by_xla(by_xla: Any, batched: Any, arguments: Any) -> Any:
    """Evaluates several networks at once; `batched` says which arguments have a first axis more."""
    axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
    return jax.vmap(by_xla, axes)(*arguments)


def _batching(function: Any, by_xla: Any) -> Any:
    """Takes a batch of points as more rows; several networks at once are left to XLA."""
    wrapped = custom_vmap(function)

    @plain  # traced again when a caller batches it, in the caller's modes
    def of_batch(size: int, batched: Any, *arguments: Any) -> Any:
        if any(jax.tree.leaves(batched[:2])):
            result = batch_by_xla(by_xla, batched, arguments)
        else:
            result = wrapped(*arguments)
        return result, jax.tree.map(lambda _: True, result)

    wrapped.def_vmap(of_batch)
    return wrapped


_value = _batching(_value_by_xla, _value_by_xla)
_chosen_value = _batching(_choose_value, _value_by_xla)
_value_and_gradient = _batching(_value_and_gradient_by_xla, _value_and_gradient_by_xla)
_chosen_value_and_gradient = _batching(_choose_value_and_gradient, _value_and_gradient_by_xla)


def _by_kernel(
    frequency: jax.Array, params: Any, points: jax.Array, *, with_gradient: bool
) -> tuple[jax.Array, jax.Array]:
    from hiosdf_jax._src.network import hopper_kernel  # needs a jax with GPU kernels

    first, weights, biases, output = kernel_arguments(frequency, params)
    if not with_gradient:
        weights = weights[: weights.shape[0] // 2]
    rows = points.reshape(-1, 3)
    count = rows.shape[0]
    value, gradient = hopper_kernel.evaluate(
        jnp.pad(rows, ((0, -count % hopper_kernel.TILE), (0, 0))),
        first,
        weights,
        biases,
        output,
        with_gradient=with_gradient,
        multiprocessors=multiprocessors(),
        interpret=INTERPRET,
    )
    value = value[:count].reshape(points.shape[:-1]) + forward.layers_of(params)[-1][1][0]
    return value, gradient[:, :count].T.reshape(points.shape)


def kernel_arguments(frequency: Any, params: Any) -> tuple[jax.Array, ...]:
    """Returns `first`, `weights`, `biases` and `output` of `hopper_kernel.evaluate`."""
    (first, first_bias), *hidden, (last, _) = forward.layers_of(params)
    kernels, biases = (jnp.stack(parts) for parts in zip(*hidden, strict=True))
    weights = (frequency * kernels).astype(jnp.float16)
    weights = jnp.concatenate([weights, weights.transpose(0, 2, 1)[::-1]])
    return (
        frequency * jnp.concatenate([first, first_bias[None]]),
        weights.reshape(-1, weights.shape[-1]),
        frequency * biases,
        last[:, 0],
    )


def multiprocessors() -> int:
    """Returns the number of the device's multiprocessors."""
    return getattr(jax.devices()[0], "core_count", 132)
