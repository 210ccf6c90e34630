"""One kernel for the derivatives of a SIREN's training loss on a Hopper GPU (Pallas Mosaic GPU).

`hopper_parts` says how a kernel works. With slopes a tile makes four passes, without them only the
first and the last:

1. forward: sines s and cosines c of each layer, and the value;
2. back: r = u * c, where u = r_next W^T, and the gradient by the points;
3. forward, the derivative of pass 2: the loss by u, which is c times the loss by r;
4. back, the derivative of pass 1: the loss by the layers' angles.

The gradient of a layer's weights is a product over all points, left to XLA: s^T times the loss by
the angles, plus the loss by u, transposed, times r. So the kernel writes these four for each layer.
What else a later pass needs waits in global memory: the cosines, u * s, and u * s times the loss by
r. Blocks of the next layer are on their way while one is computed.

On an H200 with jax 0.11.2, ten epochs of 42,000 samples of the default configuration take 2.9 ms
(XLA 5.2). The kernels compile for 7 s more. At width 256 shared memory has no room for what comes
in beside what goes out. In turn in the same room, the paper's training took 12.0 ms (XLA 14.1), and
compiled for 17 s more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl

from hiosdf_jax._src.network.hopper_parts import (
    COLUMNS,
    LAYOUT,
    ROWS,
    STAGES,
    SWIZZLED,
    TILE,
    WARPGROUPS,
    across,
    first_angle_at,
    gpu,
    kernel,
    load_column,
    multiply,
    part,
    send_results,
    share_work,
    spread,
)
from hiosdf_jax._src.network.loss import LEAST_SQUARE

Blocks = tuple[jax.Array, ...]  # (64, D) float16, in blocks of columns


class Factors(NamedTuple):
    """What the gradients of the weights are products of; P is 2 with slopes, else 1.

    Attributes:
        value: The values without the output's bias, (N,) float32.
        gradient: Their gradients by coordinate, (3, N) float32; undefined without slopes.
        inputs: The sines before the hidden layers, and the loss by u, (L, P, N, D) float16.
        angles: The loss by the hidden layers' angles, and r, (L, P, N, D) float16.
        last: As `inputs`, of the output layer, (P, N, D) float16.
        first: As `angles`, of the input layer, (P, N, D) float16.
    """

    value: jax.Array
    gradient: jax.Array
    inputs: jax.Array
    angles: jax.Array
    last: jax.Array
    first: jax.Array


def factors(
    points: jax.Array,
    targets: jax.Array,
    first: jax.Array,
    weights: jax.Array,
    biases: jax.Array,
    output: jax.Array,
    *,
    with_slopes: bool,
    multiprocessors: int,
    interpret: Any = None,
) -> Factors:
    """Computes the loss's derivatives of a SIREN whose weights are already multiplied by omega_0.

    The loss is the sum of `a |f - s| + b | |grad f| - 1 |` over the points.

    Args:
        points: (N, 3) float32, N a multiple of `TILE`.
        targets: (3, N) float32: s less the output's bias, a, and b of each point.
        first: (4, D) float32: the input layer's three rows of weights and its bias.
        weights: L kernels (D, D) in the order of their use, then their transposes in reverse order,
            as (2 L D, D) float16.
        biases: (L, D) float32, of the hidden layers.
        output: (D,) float32, the output's weights.
        with_slopes: Whether the loss has the second term.
        multiprocessors: Number of the device's multiprocessors.
        interpret: Pallas's parameters to interpret the kernel on a CPU.

    Returns:
        The factors of the gradients.
    """
    (layers, width), count = biases.shape, points.shape[0]
    blocks = width // COLUMNS
    tiles = count // TILE
    grid = min(multiprocessors, tiles)
    parts = 2 if with_slopes else 1
    steps = _steps_per_tile(parts, layers, blocks)

    def body(references: _References, scratch: _Scratch) -> None:
        warpgroup, cell = lax.axis_index("warpgroup"), lax.axis_index("cell")
        turns = (tiles - cell + grid - 1) // grid

        def compute_tile(turn: jax.Array, _: None) -> None:
            tile = _Tile(
                count=count,
                layers=layers,
                blocks=blocks,
                parts=parts,
                reference=references,
                scratch=scratch,
                warpgroup=warpgroup,
                cell=cell,
                turn=turn,
                start=(turn * grid + cell) * TILE + warpgroup * ROWS,
                interpret=interpret,
            )
            _compute(tile)

        constants = [
            (references.first, scratch.first_rows),
            (references.biases, scratch.bias_rows),
            (references.output, scratch.output_row),
        ]
        barriers = (scratch.filled, scratch.free, scratch.loaded)
        streams = (references.weights, scratch.streamed)
        share_work(compute_tile, turns, steps, constants, *streams, barriers, interpret)

    def entry(*references: Any) -> None:
        room = (WARPGROUPS * 2, ROWS, width)
        pl.run_scoped(
            lambda *scratch: body(_References(*references), _Scratch(*scratch)),
            gpu.SMEM((STAGES, COLUMNS, width), jnp.float16, transforms=SWIZZLED),
            gpu.SMEM(first.shape, jnp.float32),
            gpu.SMEM(biases.shape, jnp.float32),
            gpu.SMEM(output.shape, jnp.float32),
            gpu.SMEM((WARPGROUPS, ROWS), jnp.float32),
            gpu.SMEM((WARPGROUPS, 3, ROWS), jnp.float32),
            gpu.SMEM(room, jnp.float16, transforms=SWIZZLED),
            gpu.SMEM(room, jnp.float16, transforms=SWIZZLED),
            gpu.Barrier(num_barriers=STAGES),
            gpu.Barrier(num_barriers=STAGES, num_arrivals=WARPGROUPS),
            gpu.Barrier(num_barriers=3),
            gpu.Barrier(num_barriers=WARPGROUPS * 2),
            collective_axes="warpgroup",
        )

    def half_rows(rows: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((rows, width), jnp.float16)

    waiting_rows = grid * WARPGROUPS * (layers + 1) * ROWS
    results = [
        jax.ShapeDtypeStruct((count,), jnp.float32),
        jax.ShapeDtypeStruct((3, count), jnp.float32),
        *[half_rows(layers * parts * count)] * 2,
        *[half_rows(parts * count)] * 2,
        half_rows(waiting_rows),
        half_rows(waiting_rows if with_slopes else ROWS),
    ]
    run = kernel(entry, results, grid, interpret)
    value, gradient, inputs, angles, last, behind_first, _, _ = run(
        points, targets, first, weights, biases, output
    )
    shape = (parts, count, width)
    return Factors(
        value,
        gradient,
        inputs.reshape(layers, *shape),
        angles.reshape(layers, *shape),
        last.reshape(shape),
        behind_first.reshape(shape),
    )


class _References(NamedTuple):
    """Arrays in global memory: arguments, results, and what waits for a later pass."""

    points: Any
    targets: Any
    first: Any
    weights: Any
    biases: Any
    output: Any
    value: Any
    gradient: Any
    inputs: Any
    angles: Any
    last: Any
    before_first: Any
    cosines: Any
    products: Any


class _Scratch(NamedTuple):
    """Arrays in shared memory, and the barriers."""

    streamed: Any
    first_rows: Any
    bias_rows: Any
    output_row: Any
    values: Any
    gradients: Any
    coming: Any
    going: Any
    filled: Any
    free: Any
    loaded: Any
    arrived: Any


@dataclasses.dataclass(frozen=True)
class _Tile:
    """The 64 points that a warpgroup takes through the network in one turn.

    Two (64, D) arrays of each warpgroup come in, and two go out, at a time.

    Attributes:
        count: N, the number of all points.
        layers: L, the number of hidden layers.
        blocks: Number of blocks of columns.
        parts: 2 with slopes, else 1.
        reference: Arrays in global memory.
        scratch: Arrays in shared memory.
        warpgroup: Number of the warpgroup, () int32.
        cell: Number of the running kernel, () int32.
        turn: Number of the turn, () int32.
        start: Number of the first point, () int32.
        interpret: Pallas's parameters to interpret the kernel on a CPU.
    """

    count: int
    layers: int
    blocks: int
    parts: int
    reference: _References
    scratch: _Scratch
    warpgroup: jax.Array
    cell: jax.Array
    turn: jax.Array
    start: jax.Array
    interpret: Any

    def read(self, which: int, block: int, room: Any = None) -> jax.Array:
        """Reads a block of the array 0 or 1 that came in, or of one that is in another room."""
        room = self.scratch.coming if room is None else room
        place = self._place_of(room, which, block)
        return gpu.load(place, layout=LAYOUT).astype(jnp.float32)

    def write(self, x: jax.Array, which: int, block: int) -> jax.Array:
        """Writes a block of the array 0 or 1 that goes out; returns it as float16."""
        x = x.astype(jnp.float16)
        self._place_of(self.scratch.going, which, block)[...] = x
        return x

    def _place_of(self, room: Any, which: int, block: int) -> Any:
        return room.at[self.warpgroup * 2 + which, :, pl.ds(block * COLUMNS, COLUMNS)]

    def fetch(self, which: int, source: Any) -> None:
        """Begins to load the array 0 or 1 that comes in."""
        slot = self.warpgroup * 2 + which
        gpu.copy_gmem_to_smem(source, self.scratch.coming.at[slot], self.scratch.arrived.at[slot])

    def await_fetched(self, arrays: int) -> None:
        """Waits until the first one or two arrays have come in."""
        for which in range(arrays):
            gpu.barrier_wait(self.scratch.arrived.at[self.warpgroup * 2 + which])

    def await_room(self) -> None:
        """Waits until the arrays that go out may be written again."""
        gpu.wait_smem_to_gmem(0, wait_read_only=True)

    def await_sent(self) -> None:
        """Waits until all that went out is in global memory."""
        gpu.wait_smem_to_gmem(0)

    def send(self, which: int, target: Any) -> None:
        """Begins to store the array 0 or 1 that goes out."""
        gpu.copy_smem_to_gmem(self.scratch.going.at[self.warpgroup * 2 + which], target)

    def rows_of(self, reference: Any, index: Any) -> Any:
        """This tile's rows of the index-th array of N rows."""
        return reference.at[pl.ds(index * self.count + self.start, ROWS)]

    def waiting(self, reference: Any, layer: Any) -> Any:
        """This warpgroup's rows for a later pass, of layer 0 to L."""
        index = (self.cell * WARPGROUPS + self.warpgroup) * (self.layers + 1) + layer
        return reference.at[pl.ds(index * ROWS, ROWS)]

    def send_behind(self, which: int, layer: Any, kind: int) -> None:
        """Sends s (kind 0) or the loss by u (kind 1) of layer 0 to L."""

        @pl.when(layer < self.layers)
        def _() -> None:
            self.send(which, self.rows_of(self.reference.inputs, layer * self.parts + kind))

        @pl.when(layer == self.layers)
        def _() -> None:
            self.send(which, self.rows_of(self.reference.last, kind))

    def send_before(self, which: int, layer: Any, kind: int) -> None:
        """Sends the loss by the angles (kind 0) or r (kind 1) of layer 0 to L."""

        @pl.when(layer > 0)
        def _() -> None:
            self.send(which, self.rows_of(self.reference.angles, (layer - 1) * self.parts + kind))

        @pl.when(layer == 0)
        def _() -> None:
            self.send(which, self.rows_of(self.reference.before_first, kind))

    def product(self, x: Blocks, number: Any) -> jax.Array:
        """Multiplies by the number-th (D, D) of weights that the tile uses."""
        steps = _steps_per_tile(self.parts, self.layers, self.blocks)
        begin = self.turn * steps + number * self.blocks

        def slot(block: int) -> jax.Array:
            return lax.rem(begin + block, jnp.int32(STAGES))

        streamed, filled, free = self.scratch.streamed, self.scratch.filled, self.scratch.free
        return multiply(x, streamed, filled, free, slot, self.interpret)

    def turn_back(self, kind: int, factor: jax.Array | float) -> Blocks:
        """Computes what the last layer passes back, from the cosines that just went out."""
        self.await_sent()
        back = []
        for block in range(self.blocks):
            output = spread(self.scratch.output_row, block) * factor
            cosine = self.read(1, block, self.scratch.going)
            back.append(self.write(output * cosine, 0, block))
        gpu.commit_smem()
        self.send_before(0, jnp.int32(self.layers), kind)
        return tuple(back)


def _steps_per_tile(parts: int, layers: int, blocks: int) -> int:
    """Returns how many blocks of weights a tile uses."""
    return 2 * parts * layers * blocks


def _loop(begin: int, end: int, step: Callable[..., Blocks], x: Blocks) -> Blocks:
    # Also where jax_enable_x64 is set, indices are int32.
    return lax.fori_loop(jnp.int32(begin), jnp.int32(end), step, x)


def _evaluate(tile: _Tile) -> jax.Array:
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


def _differentiate(tile: _Tile) -> list[jax.Array]:
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


def _differentiate_slopes(tile: _Tile, by_value: jax.Array, by_gradient: list[jax.Array]) -> Blocks:
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


def _finish(tile: _Tile, back: Blocks) -> None:
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


def _compute(tile: _Tile) -> None:
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
