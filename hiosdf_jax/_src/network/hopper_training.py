"""One kernel for the derivatives of a SIREN's training loss on a Hopper GPU (Pallas Mosaic GPU).

`hopper_parts` says how a kernel works, `hopper_passes` what it computes for a tile of points.

On an H200 with jax 0.11.2, ten epochs of 42,000 samples of the default configuration take 2.9 ms
(XLA 5.2). The kernels compile for 7 s more. At width 256 shared memory has no room for what comes
in beside what goes out. In turn in the same room, the paper's training took 12.0 ms (XLA 14.1), and
compiled for 17 s more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl

from hiosdf_jax._src.network.hopper_parts import (
    COLUMNS,
    ROWS,
    STAGES,
    SWIZZLED,
    TILE,
    WARPGROUPS,
    gpu,
    kernel,
    share_work,
)
from hiosdf_jax._src.network.hopper_passes import compute
from hiosdf_jax._src.network.hopper_tile import References, Scratch, Tile, steps_per_tile


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
    steps = steps_per_tile(parts, layers, blocks)

    def body(references: References, scratch: Scratch) -> None:
        warpgroup, cell = lax.axis_index("warpgroup"), lax.axis_index("cell")
        turns = (tiles - cell + grid - 1) // grid

        def compute_tile(turn: jax.Array, _: None) -> None:
            tile = Tile(
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
            compute(tile)

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
            lambda *scratch: body(References(*references), Scratch(*scratch)),
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
