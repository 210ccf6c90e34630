"""A tile of points in the training kernel: where its arrays lie, and how they move."""

from __future__ import annotations

import dataclasses
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
    WARPGROUPS,
    gpu,
    multiply,
    spread,
)

Blocks = tuple[jax.Array, ...]  # (64, D) float16, in blocks of columns


class References(NamedTuple):
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


class Scratch(NamedTuple):
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
class Tile:
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
    reference: References
    scratch: Scratch
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
        steps = steps_per_tile(self.parts, self.layers, self.blocks)
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


def steps_per_tile(parts: int, layers: int, blocks: int) -> int:
    """Returns how many blocks of weights a tile uses."""
    return 2 * parts * layers * blocks
