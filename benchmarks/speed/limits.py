"""Rates of the machine, measured, and the least work of training, distances and network queries.

The share of a limit is the least time that the operations or the bytes of a row take on this
machine, divided by the row's median.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.speed.rows import Measured, Row, Spread, single, time_ms
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.distance import axis_order
from hiosdf_jax._src.grid.windows import Window
from hiosdf_jax._src.network import forward


class Limits(NamedTuple):
    """Measured rates.

    Attributes:
        matrix: Operations per second of a large matrix product, in the network's data type.
        vector: float32 operations per second outside matrix products.
        memory: Bytes per second, read and written, where a large array is changed in place.
    """

    matrix: float
    vector: float
    memory: float


class Work(NamedTuple):
    """Operations and least traffic of an algorithm.

    Attributes:
        matrix: Operations in matrix products; a multiply-add is two.
        vector: Other operations.
        memory: Bytes between the processor and its memory.
    """

    matrix: float = 0.0
    vector: float = 0.0
    memory: float = 0.0


# The vector rate is measured on independent chains, so that none waits for itself.
_STEPS, _CHAINS = 64, 4


def measure(matrix_edge: int, elements: int, seconds: float) -> tuple[Limits, Measured]:
    """Measures the machine's rates.

    Args:
        matrix_edge: Rows and columns of the matrices.
        elements: float32 numbers in the other arrays, enough that an accelerator takes longer to
            process them than to be called.
        seconds: How long to time each.

    Returns:
        The rates, and rows with them.
    """
    dtype = jnp.dtype(forward.stored_dtype())
    key = jax.random.key(0)
    square = jax.random.normal(key, (matrix_edge, matrix_edge), dtype)
    product = time_ms(jax.jit(jnp.matmul), square, square, seconds=seconds)
    numbers = jax.random.uniform(key, (elements,))
    in_place = jax.jit(lambda x: x + 1, donate_argnums=0)
    held = [numbers + 1]

    def change() -> jax.Array:  # a new page would cost a CPU more than writing to it
        held[0] = in_place(held[0])
        return held[0]

    changed = time_ms(change, seconds=seconds)

    def chains(x: jax.Array, factor: jax.Array) -> jax.Array:
        several = [x + k for k in range(_CHAINS)]
        for _ in range(_STEPS):
            several = [one * factor + x for one in several]
        return sum(several, jnp.zeros_like(x))

    chained = time_ms(jax.jit(chains), numbers, jnp.float32(0.5), seconds=seconds)
    limits = Limits(
        matrix=2.0 * matrix_edge**3 / (1e-3 * product.median),
        vector=2.0 * _STEPS * _CHAINS * elements / (1e-3 * chained.median),
        memory=2.0 * numbers.nbytes / (1e-3 * changed.median),
    )
    rows = [
        (f"limit: {dtype} matrix product", "TFLOP/s", 1e-12 * limits.matrix),
        ("limit: float32 multiply-adds", "TFLOP/s", 1e-12 * limits.vector),
        ("limit: memory, read + write", "GB/s", 1e-9 * limits.memory),
    ]
    return limits, Measured([Row(name, unit, single(value)) for name, unit, value in rows])


def row(limits: Limits, name: str, spread: Spread, work: Work | None, compare: str) -> Row:
    """Makes a row in ms with the share of its limit.

    Args:
        limits: The machine's rates.
        name: What was timed.
        spread: Its times, ms.
        work: Its work; None to state no limit.
        compare: Key of its baselines.

    Returns:
        The row.
    """
    limit, reached = share(limits, work, spread.median) if work else ("", math.nan)
    return Row(name, "ms", spread, compare, limit, reached)


def share(limits: Limits, work: Work, median_ms: float) -> tuple[str, float]:
    """Finds the narrowest limit and the share of it that was reached."""
    least = {name: getattr(work, name) / getattr(limits, name) for name in Limits._fields}
    name = max(least, key=lambda one: least[one])
    return name, 1e3 * least[name] / median_ms


def training_work(config: Config) -> Work:
    """Counts the work of an update's training.

    A sample with a slope takes 6 products per layer and epoch: the value, the gradient by the
    point, and two for the reverse-mode evaluation of each. A sample without a slope takes 3. The
    residuals at the end take 1.
    """
    samples = config.near_samples + config.far_samples
    samples += config.local_points * config.local_ray_samples
    sloped = -(-samples // config.eikonal_every)
    products = config.epochs * (6 * sloped + 3 * (samples - sloped)) + samples
    return _network_work(config, products)


def network_query_work(config: Config, points: int) -> Work:
    """Counts the work of values and gradients by the point: 2 products per layer."""
    return _network_work(config, 2 * points)


def _network_work(config: Config, products: int) -> Work:
    """Counts the work of products with all layers, each at one point.

    A product with all layers multiplies and adds 3 H + L H^2 + H numbers. Each of the L layers
    between hidden ones reads H numbers and writes H, in the data type of the activations; products
    that sum over the points, by the weights, read both. This is the least traffic of products that
    are kernels of their own. Sines, losses and the optimizer are not counted.
    """
    width, layers = config.hidden_width, config.hidden_layers
    adds = 3 * width + layers * width**2 + width
    size = jnp.dtype(forward.stored_dtype()).itemsize
    return Work(matrix=2.0 * products * adds, memory=2.0 * products * layers * width * size)


def distance_work(config: Config, window: Window) -> Work:
    """Counts the work of the distance transform: comparisons, and memory read and written once.

    The transform of an axis compares each voxel with those within the horizon along it, with seven
    operations each: two sums, a product, a conversion to bits, two operations on them, and a
    minimum. It cuts the box down along its axis. There are two searches. The evidence (hits,
    passes, behind, mean and axes) has 30 bytes per voxel; the distances (nearest, sdf and doubt)
    have 7 per voxel that can change.
    """
    shape, compared = list(window.shape), 0
    for axis in axis_order(config):
        reach = min(config.horizon_voxels, shape[axis] - 1)
        shape[axis] = window.inner_shape[axis]
        compared += 2 * reach * math.prod(shape)
    memory = 30.0 * math.prod(window.shape) + 7.0 * math.prod(window.inner_shape)
    return Work(vector=2 * 7.0 * compared, memory=memory)
