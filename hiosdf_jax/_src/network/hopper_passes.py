"""The passes of the training kernel over a tile of points.

With slopes a tile makes four passes, without them only the first and the last:

1. forward: sines s and cosines c of each layer, and the value;
2. back: r = u * c, where u = r_next W^T, and the gradient by the points;
3. forward, the derivative of pass 2: the loss by u, which is c times the loss by r;
4. back, the derivative of pass 1: the loss by the layers' angles.

The gradient of a layer's weights is a product over all points, left to XLA: s^T times the loss by
the angles, plus the loss by u, transposed, times r. So the kernel writes these four for each layer.
What else a later pass needs waits in global memory: the cosines, u * s, and u * s times the loss by
r. Blocks of the next layer are on their way while one is computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl

from hiosdf_jax._src.network.hopper_parts import (
    ROWS,
    across,
    first_angle_at,
    gpu,
    load_column,
    part,
    send_results,
    spread,
)
from hiosdf_jax._src.network.hopper_tile import Blocks, Tile
from hiosdf_jax._src.network.loss import LEAST_SQUARE


def compute(tile: Tile) -> None:
    """Computes all factors of a tile."""
    scratch, reference = tile.scratch, tile.reference
    value = _evaluate(tile)
    target, value_weight, slope_weight = (
        load_column(reference.targets.at[row, pl.ds(tile.start, ROWS)]) for row in range(3)
    )
    by_value = across(jnp.where(value < target, -value_weight, value_weight))
    slopes = None
    if tile.parts == 2:
        gradient = _differentiate(tile)
        slope = jnp.sqrt(sum((g * g for g in gradient), LEAST_SQUARE))
        by_slope = jnp.where(slope < 1, -slope_weight, slope_weight) / slope
        by_gradient = [across(by_slope * g) for g in gradient]
        back = _differentiate_slopes(tile, by_value, by_gradient)
        slopes = (scratch.gradients, reference.gradient)
    else:
        back = tile.turn_back(0, by_value)
    _finish(tile, back)
    send_results(tile.warpgroup, tile.start, (scratch.values, reference.value), slopes)


def _loop(begin: int, end: int, step: Callable[..., Blocks], x: Blocks) -> Blocks:
    # Also where jax_enable_x64 is set, indices are int32.
    return lax.fori_loop(jnp.int32(begin), jnp.int32(end), step, x)


def _evaluate(tile: Tile) -> jax.Array:
    """Pass 1: returns the values without the output's bias, (64,)."""
    scratch = tile.scratch
    first_angle = first_angle_at(tile.reference.points, scratch.first_rows, tile.start)

    def activate(layer: Any, angle_of: Callable[[int], jax.Array]) -> Blocks:
        tile.await_room()
        sines = []
        for block in range(tile.blocks):
            angle = angle_of(block)
            sines.append(tile.write(jnp.sin(angle), 0, block))
            tile.write(jnp.cos(angle), 1, block)
        gpu.commit_smem()
        tile.send_behind(0, layer, 0)
        tile.send(1, tile.waiting(tile.reference.cosines, layer))
        return tuple(sines)

    def forward(layer: jax.Array, sines: Blocks) -> Blocks:
        z = tile.product(sines, layer - 1)
        bias = scratch.bias_rows.at[layer - 1]
        return activate(layer, lambda block: part(z, block) + spread(bias, block))

    sines = _loop(1, tile.layers + 1, forward, activate(jnp.int32(0), first_angle))
    value: Any = 0
    for block in range(tile.blocks):
        sine = sines[block].astype(jnp.float32)
        value += (sine * spread(scratch.output_row, block)).sum(axis=1)
    scratch.values.at[tile.warpgroup][...] = value
    return value


def _differentiate(tile: Tile) -> list[jax.Array]:
    """Pass 2: returns the gradients by coordinate, three times (64,)."""
    scratch, reference = tile.scratch, tile.reference

    def fetch(layer: Any) -> None:
        tile.fetch(0, tile.waiting(reference.cosines, layer))
        tile.fetch(1, tile.rows_of(reference.inputs, layer * tile.parts))

    def descend(index: jax.Array, back: Blocks) -> Blocks:
        layer = tile.layers - 1 - index
        u = tile.product(back, tile.layers + index)
        tile.await_fetched(2)
        tile.await_room()
        result = []
        for block in range(tile.blocks):
            result.append(tile.write(part(u, block) * tile.read(0, block), 0, block))
            tile.write(part(u, block) * tile.read(1, block), 1, block)
        gpu.commit_smem()
        tile.send_before(0, layer, 1)
        tile.send(1, tile.waiting(reference.products, layer))
        pl.when(layer > 0)(lambda: fetch(layer - 1))
        return tuple(result)

    back = tile.turn_back(1, 1.0)
    fetch(jnp.int32(tile.layers - 1))
    back = _loop(0, tile.layers, descend, back)
    gradient: list[Any] = [0] * 3
    for block in range(tile.blocks):
        r = back[block].astype(jnp.float32)
        for axis in range(3):
            gradient[axis] += (r * spread(scratch.first_rows.at[axis], block)).sum(axis=1)
    for axis in range(3):
        scratch.gradients.at[tile.warpgroup, axis][...] = gradient[axis]
    return gradient


def _differentiate_slopes(tile: Tile, by_value: jax.Array, by_gradient: list[jax.Array]) -> Blocks:
    """Pass 3: the derivative of pass 2.

    Args:
        tile: The tile.
        by_value: The loss by the value, for all neurons of a block, (64, 64).
        by_gradient: The loss by the gradient, three times (64, 64).

    Returns:
        The loss by the last layer's angles.
    """
    scratch, reference, layers = tile.scratch, tile.reference, tile.layers

    def fetch(layer: Any) -> None:
        tile.fetch(0, tile.waiting(reference.cosines, layer))
        # The last layer's u are the output's weights.
        pl.when(layer < layers)(lambda: tile.fetch(1, tile.waiting(reference.products, layer)))
        pl.when(layer == layers)(lambda: tile.fetch(1, tile.rows_of(reference.last, 0)))

    def differentiate(layer: Any, by_r: Callable[[int], jax.Array]) -> Blocks:
        tile.await_fetched(2)
        tile.await_room()
        is_last = jnp.where(layer == layers, jnp.float32(1), jnp.float32(0))
        by_u = []
        for block in range(tile.blocks):
            cosine = tile.read(0, block)
            curved = by_r(block) * tile.read(1, block)
            by_u.append(tile.write(by_r(block) * cosine, 0, block))
            by_angle = spread(scratch.output_row, block) * (by_value * cosine - curved)
            tile.write(curved + is_last * (by_angle - curved), 1, block)
        gpu.commit_smem()
        tile.send_behind(0, layer, 1)
        tile.send(1, tile.waiting(reference.products, layer))
        pl.when(layer < layers)(lambda: fetch(layer + 1))
        return tuple(by_u)

    def ascend(layer: jax.Array, by_u: Blocks) -> Blocks:
        by_r = tile.product(by_u, 2 * layers + layer - 1)
        return differentiate(layer, lambda block: part(by_r, block))

    def first_by_r(block: int) -> jax.Array:
        x, y, z = (by_gradient[a] * spread(scratch.first_rows.at[a], block) for a in range(3))
        return x + y + z

    tile.await_sent()
    fetch(jnp.int32(0))
    by_u = differentiate(jnp.int32(0), first_by_r)
    _loop(1, layers + 1, ascend, by_u)
    tile.await_sent()
    blocks = range(tile.blocks)
    back = tuple(tile.read(1, block, scratch.going).astype(jnp.float16) for block in blocks)
    tile.send_before(1, jnp.int32(layers), 0)
    return back


def _finish(tile: Tile, back: Blocks) -> None:
    """Pass 4, from the loss by the last layer's angles."""
    reference, with_slopes = tile.reference, tile.parts == 2

    def fetch(layer: Any) -> None:
        tile.fetch(0, tile.waiting(reference.cosines, layer))
        if with_slopes:
            tile.fetch(1, tile.waiting(reference.products, layer))

    def descend(index: jax.Array, back: Blocks) -> Blocks:
        layer = tile.layers - 1 - index
        by_sine = tile.product(back, (2 * tile.parts - 1) * tile.layers + index)
        tile.await_fetched(tile.parts)
        tile.await_room()
        result = []
        for block in range(tile.blocks):
            by_angle = part(by_sine, block) * tile.read(0, block)
            if with_slopes:
                by_angle = by_angle - tile.read(1, block)
            result.append(tile.write(by_angle, 0, block))
        gpu.commit_smem()
        tile.send_before(0, layer, 0)
        pl.when(layer > 0)(lambda: fetch(layer - 1))
        return tuple(result)

    fetch(jnp.int32(tile.layers - 1))
    _loop(0, tile.layers, descend, back)
