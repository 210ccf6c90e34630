"""What the kernels for Hopper GPUs share (Pallas Mosaic GPU).

A kernel has three warpgroups. Each of two takes 64 points at a time through all layers, with
activations in registers as float16. The tensor cores accumulate in float32. The third warpgroup
streams the weights, block by block, through shared memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu

gpu: Any = mosaic_gpu  # its types name no public constructors

ROWS = 64  # points of a warpgroup: the height of a Hopper matrix product
COLUMNS = 64  # neurons of a block: 128 bytes, the width of a swizzle
WARPGROUPS = 2  # that compute; one more streams the weights
TILE = WARPGROUPS * ROWS
STAGES = 4  # blocks of weights on their way

LAYOUT = gpu.Layout.WGMMA
SWIZZLED = (gpu.TilingTransform((8, COLUMNS)), gpu.SwizzleTransform(128))

# Registers per thread. The streaming warpgroup gives its share to those that compute.
_COMPUTING_REGISTERS, _STREAMING_REGISTERS = 240, 24


def spread(row: Any, block: int) -> jax.Array:
    """Loads a block of a row of D numbers, and repeats it for all points, (64, 64)."""
    place = row.at[pl.ds(block * COLUMNS, COLUMNS)]
    part = gpu.load(place, layout=LAYOUT.reduce(0))
    return lax.broadcast_in_dim(part, (ROWS, COLUMNS), [1])


def load_column(place: Any) -> jax.Array:
    """Loads a number per point from global memory, (64,)."""
    return gpu.load(place, layout=LAYOUT.reduce(1), optimized=False)


def across(column: jax.Array) -> jax.Array:
    """Repeats a number per point, (64,), for all neurons of a block, (64, 64)."""
    return lax.broadcast_in_dim(column, (ROWS, COLUMNS), [0])


def part(x: jax.Array, block: int) -> jax.Array:
    """Returns a block of columns of (64, D)."""
    return x[:, block * COLUMNS : (block + 1) * COLUMNS]


def first_angle_at(points: Any, first_rows: Any, start: jax.Array) -> Callable[[int], jax.Array]:
    """Loads 64 points, and returns what computes the input layer's angles there, block by block.

    Args:
        points: Points in global memory, (N, 3) float32, m.
        first_rows: The input layer's three rows of weights and its bias, (4, D) float32.
        start: Number of the first point, () int32.
    """
    coordinates = [across(load_column(points.at[pl.ds(start, ROWS), axis])) for axis in range(3)]

    def first_angle(block: int) -> jax.Array:
        # Meters need all of float32.
        angle = spread(first_rows.at[3], block)
        for axis in range(3):
            angle = angle + coordinates[axis] * spread(first_rows.at[axis], block)
        return angle

    return first_angle


def send_results(
    warpgroup: jax.Array, start: Any, values: tuple[Any, Any], gradients: tuple[Any, Any] | None
) -> None:
    """Sends a warpgroup's values, and gradients if there are any, and waits until all is sent.

    Args:
        warpgroup: Its number, () int32.
        start: Number of its first point, () int32.
        values: Their places in shared memory, (warpgroups, 64), and in global memory, (N,).
        gradients: Likewise, (warpgroups, 3, 64) and (3, N); None without them.
    """
    rows = pl.ds(start, ROWS)
    gpu.commit_smem()
    gpu.copy_smem_to_gmem(values[0].at[warpgroup], values[1].at[rows])
    if gradients is not None:
        for axis in range(3):
            gpu.copy_smem_to_gmem(gradients[0].at[warpgroup, axis], gradients[1].at[axis, rows])
    gpu.wait_smem_to_gmem(0)


def multiply(
    x: Any,
    streamed: Any,
    filled: Any,
    free: Any,
    slot: Callable[[int], jax.Array],
    interpret: Any,
) -> jax.Array:
    """Multiplies points by the (D, D) of weights whose blocks come next.

    Args:
        x: (64, D) float16, in blocks of columns.
        streamed: Blocks of weights in shared memory, (stages, 64, D) float16.
        filled: A barrier per stage, which its block's arrival completes.
        free: A barrier per stage, on which each warpgroup arrives when it has used the block.
        slot: The stage of each block of weights.
        interpret: Pallas's parameters to interpret the kernel on a CPU.

    Returns:
        (64, D) float32.
    """
    blocks, width = len(x), streamed.shape[-1]

    def accumulate(total: Any) -> jax.Array:
        for block in range(blocks):
            place = slot(block)
            gpu.barrier_wait(filled.at[place])
            gpu.wgmma(total, x[block], streamed.at[place])
            if block > 0:
                gpu.wgmma_wait(1)
                gpu.barrier_arrive(free.at[slot(block - 1)])
        result = total[...]
        gpu.barrier_arrive(free.at[slot(blocks - 1)])
        return result

    if interpret is None:
        return pl.run_scoped(accumulate, gpu.ACC((ROWS, width), jnp.float32))
    total = jnp.zeros((ROWS, width), jnp.float32)  # interpreted: no such products
    for block in range(blocks):
        gpu.barrier_wait(filled.at[slot(block)])
        factor = streamed[slot(block)]
        total += jnp.dot(x[block], factor, preferred_element_type=jnp.float32)
        gpu.barrier_arrive(free.at[slot(block)])
    return total


def share_work(
    compute_tile: Callable[[jax.Array, None], None],
    turns: jax.Array,
    steps: int,
    constants: list[tuple[Any, Any]],
    weights: Any,
    streamed: Any,
    barriers: tuple[Any, Any, Any],
    interpret: Any,
) -> None:
    """Lets two warpgroups compute, and a third one stream the weights.

    Args:
        compute_tile: Computes the tile of a turn.
        turns: Number of tiles, () int32.
        steps: Blocks of weights that each tile uses. It begins with the first one.
        constants: Arrays in global memory, and the places in shared memory to load them to.
        weights: Blocks of weights in global memory, (blocks * 64, D) float16.
        streamed: Their places in shared memory, (stages, 64, D) float16.
        barriers: `filled` and `free` of `multiply`, and one for each of the constants.
        interpret: Pallas's parameters to interpret the kernel on a CPU.
    """
    filled, free, loaded = barriers
    stages, blocks = streamed.shape[0], weights.shape[0] // COLUMNS
    warpgroup = lax.axis_index("warpgroup")

    @pl.when(warpgroup < WARPGROUPS)
    def _() -> None:
        gpu.set_max_registers(_COMPUTING_REGISTERS, action="increase")

        @pl.when(warpgroup == 0)
        def _() -> None:
            for index, (source, place) in enumerate(constants):
                gpu.copy_gmem_to_smem(source, place, loaded.at[index])

        for index in range(len(constants)):
            gpu.barrier_wait(loaded.at[index])
        lax.fori_loop(0, turns, compute_tile, None)

    @pl.when(warpgroup == WARPGROUPS)
    def _() -> None:
        gpu.set_max_registers(_STREAMING_REGISTERS, action="decrease")

        def fetch(step: jax.Array, slot: Any) -> None:
            start = lax.rem(step, jnp.int32(blocks)) * COLUMNS
            block = weights.at[pl.ds(start, COLUMNS)]
            gpu.copy_gmem_to_smem(block, streamed.at[slot], filled.at[slot])

        def refill(step: jax.Array, _: None) -> None:
            slot = lax.rem(step, jnp.int32(stages))
            gpu.barrier_wait(free.at[slot])
            fetch(step, slot)

        def drain(step: jax.Array) -> None:
            gpu.barrier_wait(free.at[lax.rem(step, jnp.int32(stages))])

        for slot in range(stages):
            fetch(jnp.int32(slot), slot)
        lax.fori_loop(stages, turns * steps, refill, None)
        if interpret is not None:  # jax 0.11 wants to see every arrival awaited
            last = turns * steps
            lax.fori_loop(last, last + stages, lambda step, _: drain(step), None)


def kernel(entry: Callable[..., None], results: list[Any], grid: int, interpret: Any) -> Any:
    """Makes a kernel of three warpgroups for each of `grid` cells."""
    options = {} if interpret is None else {"interpret": interpret}
    return gpu.kernel(
        entry,
        out_type=results,
        grid=(grid,),
        grid_names=("cell",),
        num_threads=WARPGROUPS + 1,
        thread_name="warpgroup",
        compiler_params=gpu.CompilerParams(approx_math=True),
        **options,
    )
