"""What the machine can do, measured, and what a stage's algorithm has to do, counted.

The share of the limit that a stage reaches is the least time that its operations or its bytes take
on this machine over the time that it took.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.speed.rows import Row, single, time_ms
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.change import Window
from hiosdf_jax._src.grid.distance import pass_order
from hiosdf_jax._src.network import forward


class Limits(NamedTuple):
    """Rates that were measured.

    Attributes:
        matrix: Operations a second in a large matrix product, in the type that the network uses.
        vector: float32 operations a second outside matrix products.
        memory: Bytes a second that are read and written where a large array is changed in place.
    """

    matrix: float
    vector: float
    memory: float


class Work(NamedTuple):
    """What a stage's algorithm has to do: its operations, and its least traffic.

    Attributes:
        matrix: Operations in matrix products, a multiply-add being two.
        vector: Other operations.
        memory: Bytes between the processor and its memory.
    """

    matrix: float = 0.0
    vector: float = 0.0
    memory: float = 0.0


# Steps of each of the chains that the vector rate is measured on; the chains are independent, so
# that none waits for itself.
_STEPS, _CHAINS = 64, 4


def measure(matrix_edge: int, elements: int, seconds: float) -> tuple[Limits, list[Row]]:
    """Measures the machine's rates.

    Args:
        matrix_edge: Rows and columns of the matrices.
        elements: float32 numbers in the arrays that are changed and computed with; so many that an
            accelerator takes longer for them than to be called.
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

    def change() -> jax.Array:  # a new page would cost a CPU more than what is written to it
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
    return limits, [Row(name, unit, single(value)) for name, unit, value in rows]


def share(limits: Limits | None, work: Work, median_ms: float) -> tuple[str, float]:
    """The narrowest of the limits, and the share of it that was reached."""
    if limits is None:
        return "", float("nan")
    least = {name: getattr(work, name) / getattr(limits, name) for name in Limits._fields}
    name = max(least, key=lambda one: least[one])
    return name, 1e3 * least[name] / median_ms


def _network_work(config: Config, points: float, products: int) -> Work:
    """Of the network's products, `products` a layer and point.

    A pass through the network multiplies and adds 3 H + L H^2 + H numbers a point. Each product of
    the L layers between hidden ones reads H numbers a point and writes H (those that sum over the
    points, by the weights, read both): 2 H, in the type that the network's activations have. That
    is the least traffic of products that are kernels of their own; what is done between them
    (sines, losses, the optimiser) is not counted.
    """
    width, layers = config.hidden_width, config.hidden_layers
    pass_adds = 3 * width + layers * width**2 + width
    size = jnp.dtype(forward.stored_dtype()).itemsize
    return Work(
        matrix=2.0 * products * pass_adds * points,
        memory=2.0 * products * layers * width * size * points,
    )


def training_work(config: Config) -> Work:
    """Of an update's training.

    A sample with a slope takes 6 products a layer and epoch: the value, the gradient by the point,
    and two for the backward pass of each. One without takes 3. The residuals at the end take 1.
    """
    samples = config.near_samples + config.far_samples
    samples += config.local_points * config.local_ray_samples
    sloped = -(-samples // config.eikonal_every)
    products = config.epochs * (6 * sloped + 3 * (samples - sloped)) + samples
    return _network_work(config, products, 1)


def network_query_work(config: Config, points: int) -> Work:
    """Of a value and a gradient by the point: 2 products a layer."""
    return _network_work(config, points, 2)


def nearest_work(queries: int, points: int) -> Work:
    """Of comparing all pairs: three differences, three squares, two sums and a minimum each.

    Both sets are read once: 12 bytes a point; a query's answer is 4 more.
    """
    return Work(vector=9.0 * queries * points, memory=12.0 * points + 16.0 * queries)


def distance_work(config: Config, window: Window) -> Work:
    """Of the distance transform: two searches' comparisons, and the memory read and written once.

    A pass compares each voxel with those within the horizon along an axis, six operations each:
    two sums, a square, a comparison, a choice, a minimum. It shortens the box along its axis.
    Evidence: hits, passes, behind, mean (3) and axes (9) in float16, 30 bytes a voxel. Answers:
    nearest (3) in int8, sdf and doubt in float16, 7 bytes a voxel that can have changed.
    """
    shape, compared = list(window.shape), 0
    for axis in pass_order(config):
        reach = min(config.horizon_voxels, shape[axis] - 1)
        shape[axis] = window.inner_shape[axis]
        compared += 2 * reach * math.prod(shape)
    memory = 30.0 * math.prod(window.shape) + 7.0 * math.prod(window.inner_shape)
    return Work(vector=2 * 6.0 * compared, memory=memory)


def evidence_work(window: int, points: int, steps: float) -> dict[str, Work]:
    """Of the four stages that count rays in a window around the sensor.

    Hits, passes, behind and weight are stored in 2 bytes a voxel each and counted in 4, the mean
    and the axes (12 numbers) in 2. Fusion uses hits, weight, mean and axes, the rays passes and
    behind. A point has 12 bytes and a flag, a ray 16 and two. A step along a ray takes 26
    operations: its point 6, the voxel of it 9, whether that is in the window 6, where it is stored
    4, adding 1. What the steps read and write again and again is not counted.

    Args:
        window: Its voxels.
        points: Of the cloud.
        steps: Of all of its rays.

    Returns:
        The work by the stage's name.
    """
    return {
        "window": Work(memory=(32.0 + 40.0) * window),
        "fusion": Work(memory=2 * 32.0 * window + 13.0 * points),
        "rays": Work(vector=26.0 * steps, memory=2 * 8.0 * window + 18.0 * points),
        "fading": Work(memory=(40.0 + 32.0) * window),
    }


def frontier_work(config: Config, window: Window) -> Work:
    """Of the distance to unseen space: the comparisons, and the memory read and written once.

    A pass compares each voxel with those within its reach along an axis, three operations each: a
    choice, a sum, a minimum. Hits and passes are 4 bytes a voxel, an answer is 1.
    """
    reach = sum(min(config.frontier_voxels, length - 1) for length in window.shape)
    voxels = math.prod(window.shape)
    return Work(
        vector=3.0 * 2 * reach * voxels,
        memory=4.0 * voxels + 1.0 * math.prod(window.inner_shape),
    )


def grid_samples_work(config: Config) -> Work:
    """Of drawing samples from the whole map.

    Of each voxel hits, passes, behind, sdf and one number of nearest are read, 9 bytes. A sample
    reads nearest and sdf of the eight voxels around it, 5 bytes each, mean and two axes of the
    patch that they name, 18, if it is one, and is written, 20.
    """
    samples = config.near_samples + config.far_samples
    return Work(memory=9.0 * math.prod(config.grid_shape) + (8 * 5.0 + 18.0 + 20.0) * samples)


def calibration_work(config: Config, points: int, returns: int) -> Work:
    """Of asking the map at some returns of a cloud.

    Of each point a flag is read, of a return its 12 bytes, nearest, sdf, doubt and frontier of the
    eight voxels around it, 8 bytes each, and mean and axes of the patch that they name, 24.
    """
    network = _network_work(config, returns, 1)
    return network._replace(
        memory=network.memory + 1.0 * points + (12.0 + 8 * 8.0 + 24.0) * returns
    )


def baked_work(points: int) -> Work:
    """Of trilinear interpolation: a point (12 bytes) and 8 samples (32) in, 4 numbers (16) out."""
    return Work(memory=60.0 * points)
