"""Functions of points and tables: one kernel on a Hopper GPU (Pallas Triton), XLA elsewhere.

XLA makes several kernels of a function that looks things up, and each writes to memory what the
next one reads. Here one kernel computes all that belongs to a point, in registers. It is compiled
from the code that XLA compiles elsewhere. On an H100 with jax 0.11.2, 102,400 distances with
gradients by the grid take 0.04 ms (XLA 0.15).

jax has deprecated Triton in Pallas, and Mosaic has no gather. Where a version of jax has lost it,
XLA compiles the functions on all devices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.barriers import compute_once, hold, no_barriers
from hiosdf_jax._src.numerics.modes import is_varying, plain
from hiosdf_jax._src.numerics.tangents import all_zero, instantiate
from hiosdf_jax._src.numerics.vectors import Vector

# Points of a block, and its warps. Few points are spread over many blocks, so that all of a GPU
# works on them.
_FEW = 8192
_BLOCK_OF_FEW, _WARPS_OF_FEW = 8, 2
_BLOCK, _WARPS = 128, 4

# In a block of one warp, sums need no shared memory. First each thread adds up some points.
_BLOCK_OF_SUMS, _WARPS_OF_SUMS, _MOST_TURNS = 32, 1, 8

_LEAST_POINTS = 256  # fewer gain little
_MOST_POINTS = 2**26  # indices into results are int32

_KEPT = 256  # functions with a configuration that are kept

INTERPRET: Any = None  # True interprets the kernel on a CPU, for tests

Function = Callable[..., Any]


def by_points(
    function: Function,
    static: Any,
    tables: Any,
    *rows: jax.Array,
    numbers: jax.Array | None = None,
    least: int | None = None,
) -> Any:
    """Evaluates a function of points and tables.

    `jax.vmap` over points, or over numbers, makes more points of one evaluation.

    Args:
        function: A function of a module. It maps `static`, `tables`, the numbers if there are any,
            and a tuple of K arrays (...) for each array of rows, to a pytree of arrays (...) and
            tuples of them. It reads tables by one array of indices, after `ravel` or `reshape`, or
            by `vectors.take`. It holds no arrays of constants, which neither the kernel nor its
            batching takes.
        static: A hashable argument, such as a configuration.
        tables: A pytree of arrays.
        *rows: Arrays (..., K), all with the same axes (...).
        numbers: What holds for all points, (M,); the function gets a tuple of M arrays.
        least: Fewer points are left to XLA, since the kernel takes longer to compile; by default
            256.

    Returns:
        The pytree; tuples are joined to (..., K). Differentiable as the function is.
    """
    if _fits(tables, numbers, rows):
        fewest = _LEAST_POINTS if least is None else least
        return _with_kernel(function, static, fewest)(tables, numbers, *rows)
    return _by_xla(function, static, tables, numbers, *rows)


def sum_by_points(
    function: Function, static: Any, tables: Any, *rows: jax.Array, numbers: jax.Array | None = None
) -> jax.Array:
    """Sums a function of points and tables over the points, in one kernel.

    Args:
        function: As for `by_points`; the result is a tuple of M arrays (...).
        static: As for `by_points`.
        tables: As for `by_points`.
        *rows: Arrays (N, K).
        numbers: As for `by_points`.

    Returns:
        (M,). Differentiable.
    """
    if _fits(tables, numbers, rows):
        return _with_sum(function, static)(tables, numbers, *rows)
    return _sum_by_xla(function, static, tables, numbers, *rows)


def joined(results: Any) -> Any:
    """Joins the tuples of K arrays (...) in a pytree to arrays (..., K)."""

    def join(value: Any) -> jax.Array:
        return jnp.stack(value, axis=-1) if _is_tuple(value) else value

    return jax.tree.map(join, results, is_leaf=_is_tuple)


def columns(array: jax.Array) -> tuple[jax.Array, ...]:
    """Splits (..., K) to a tuple of K arrays (...)."""
    return tuple(array[..., k] for k in range(array.shape[-1]))


def _fits(*arguments: Any) -> bool:
    """Returns whether a kernel may run: its results have no type for `jax.shard_map`."""
    return devices.has_kernels() and not is_varying(arguments)


def _by_xla(function: Function, static: Any, tables: Any, numbers: Any, *rows: jax.Array) -> Any:
    given = () if numbers is None else (columns(numbers),)
    # Once: else a CPU takes twice as long for distances with gradients.
    separate = compute_once([columns(each) for each in rows])
    return joined(function(static, tables, *given, *separate))


def _sum_by_xla(
    function: Function, static: Any, tables: Any, numbers: Any, *rows: jax.Array
) -> jax.Array:
    return jnp.sum(_by_xla(function, static, tables, numbers, *rows), axis=-2)


@functools.lru_cache(_KEPT)
def _with_sum(function: Function, static: Any) -> Function:
    by_xla = plain(functools.partial(_sum_by_xla, function, static))
    by_kernel = plain(functools.partial(_sum_by_kernel, functools.partial(function, static)))
    evaluate = jax.custom_jvp(_batching(by_kernel, by_xla, _LEAST_POINTS))

    @evaluate.defjvp
    @plain
    def _(primals: Any, tangents: Any) -> Any:
        return jax.jvp(by_xla, primals, tangents)

    return evaluate


@functools.lru_cache(_KEPT)
def _with_kernel(function: Function, static: Any, least: int) -> Function:
    by_xla = plain(functools.partial(_by_xla, function, static))
    by_kernel = plain(functools.partial(_by_kernel, functools.partial(function, static)))
    evaluate = jax.custom_jvp(_batching(by_kernel, by_xla, least))

    @functools.partial(evaluate.defjvp, symbolic_zeros=True)
    @plain
    def _(primals: Any, tangents: Any) -> Any:
        (tables, numbers, *rows), steps = primals, instantiate(primals, tangents)
        if numbers is not None or len(rows) > 1 or not all_zero(tangents[0]):
            return jax.jvp(by_xla, primals, steps)
        results = _results_of(functools.partial(function, static), tables, None, rows)
        if any(result.ndim == rows[0].ndim for result in jax.tree.leaves(results)):
            return jax.jvp(by_xla, primals, steps)  # such as derivatives of gradients
        values, gradients = by_points(_with_gradients, (function, static), tables, *rows)
        leaves = [jnp.sum(gradient * steps[2], axis=-1) for gradient in gradients]
        return values, jax.tree.unflatten(jax.tree.structure(values), leaves)

    return evaluate


def _with_gradients(functions: tuple[Function, Any], tables: Any, row: Any) -> Any:
    """Computes arrays (...), and the gradient of each by the row."""
    function, static = functions
    values, pull = jax.vjp(functools.partial(function, static, tables), row)
    leaves, structure = jax.tree.flatten(values)

    def gradient(number: int) -> Any:
        chosen = [jnp.full_like(leaf, float(k == number)) for k, leaf in enumerate(leaves)]
        return pull(jax.tree.unflatten(structure, chosen))[0]

    return values, [gradient(number) for number in range(len(leaves))]


def _batching(by_kernel: Function, by_xla: Function, least: int) -> Function:
    """Takes a batch of points as more points; several sets of tables are left to XLA."""

    @custom_vmap
    def evaluate(tables: Any, numbers: Any, *rows: jax.Array) -> Any:
        count = math.prod(rows[0].shape[:-1])
        if jax.export.is_symbolic_dim(count) or not least <= count <= _MOST_POINTS:
            return _over_groups(by_xla, tables, numbers, *rows)
        by_groups = functools.partial(_over_groups, by_xla)
        return devices.choose(by_kernel, by_groups, INTERPRET, tables, numbers, *rows)

    @evaluate.def_vmap
    @plain  # traced again when a caller batches it, in the caller's modes
    def _(size: int, batched: Any, tables: Any, numbers: Any, *rows: jax.Array) -> Any:
        arguments = tables, numbers, *rows
        if any(jax.tree.leaves(batched[0])):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
            result = jax.vmap(functools.partial(_over_groups, by_xla), axes)(*arguments)
        else:

            def spread(array: jax.Array, is_batched: bool) -> jax.Array:
                return array if is_batched else jnp.broadcast_to(array, (size, *array.shape))

            result = evaluate(tables, *jax.tree.map(spread, arguments[1:], tuple(batched[1:])))
        return result, jax.tree.map(lambda _: True, result)

    return evaluate


def _over_groups(by_xla: Function, tables: Any, numbers: Any, *rows: jax.Array) -> Any:
    """Evaluates points of groups with numbers (..., M) of their own."""
    if numbers is None or numbers.ndim == 1:
        return by_xla(tables, numbers, *rows)
    axes = None, 0, *[0] * len(rows)
    return jax.vmap(functools.partial(_over_groups, by_xla), axes)(tables, numbers, *rows)


def _by_kernel(function: Function, tables: Any, numbers: Any, *rows: jax.Array) -> Any:
    from jax.experimental.pallas import triton  # needs a jax with GPU kernels

    count = math.prod(rows[0].shape[:-1])
    block, warps = (_BLOCK_OF_FEW, _WARPS_OF_FEW) if count <= _FEW else (_BLOCK, _WARPS)
    groups = 1 if numbers is None else math.prod(numbers.shape[:-1])
    shapes, results = jax.tree.flatten(_results_of(function, tables, numbers, rows))

    def body(inputs: _Inputs, outputs: Any, program: jax.Array) -> None:
        row = program * block + jax.lax.iota(jnp.int32, block)
        some = row < count
        result = inputs.evaluate(row, jax.lax.div(row, np.int32(count // groups)), some)
        for reference, value in zip(
            outputs, jax.tree.leaves(result, is_leaf=_is_tuple), strict=True
        ):
            parts = value if _is_tuple(value) else (value,)
            for k, part in enumerate(parts):
                part = jnp.broadcast_to(part, (block,)).astype(reference.dtype)
                triton.store(reference.at[len(parts) * row + k], part, mask=some)

    found = _call(
        body, function, (tables, numbers, rows), shapes, programs=-(-count // block), warps=warps
    )
    return jax.tree.unflatten(results, found)


def _sum_by_kernel(function: Function, tables: Any, numbers: Any, *rows: jax.Array) -> jax.Array:
    from jax.experimental.pallas import triton  # needs a jax with GPU kernels

    *groups, count, _ = rows[0].shape
    few = count * math.prod(groups) <= _FEW
    block, warps = (_BLOCK_OF_FEW, _WARPS_OF_FEW) if few else (_BLOCK_OF_SUMS, _WARPS_OF_SUMS)
    turns = 1 if few else min(-(-count // block), _MOST_TURNS)
    programs = -(-count // (block * turns))  # of each group
    (result,) = jax.tree.leaves(_results_of(function, tables, numbers, rows))
    width = result.shape[-1]

    def body(inputs: _Inputs, outputs: Any, program: jax.Array) -> None:
        group, number = (part(program, np.int32(programs)) for part in (jax.lax.div, jax.lax.rem))

        def add(turn: jax.Array | int, total: Sequence[jax.Array]) -> tuple[jax.Array, ...]:
            in_group = (number * turns + turn) * block + jax.lax.iota(jnp.int32, block)
            some = in_group < count
            parts = inputs.evaluate(group * count + in_group, jnp.full_like(in_group, group), some)
            return tuple(
                before + jnp.where(some, part, 0) for before, part in zip(total, parts, strict=True)
            )

        total = (jnp.zeros(block, result.dtype),) * width
        total = jax.lax.fori_loop(0, turns, add, total) if turns > 1 else add(0, total)
        for k, part in enumerate(total):
            triton.store(outputs[0].at[width * program + k], jnp.sum(part))

    shape = jax.ShapeDtypeStruct((*groups, programs, width), result.dtype)
    (found,) = _call(
        body,
        function,
        (tables, numbers, rows),
        [shape],
        programs=programs * math.prod(groups),
        warps=warps,
    )
    # Held: else XLA sums the parts that are read here and there in kernels of their own.
    return hold(jnp.sum(found, axis=-2)) if programs > 1 else found[..., 0, :]


class _Inputs:
    """What a kernel reads."""

    def __init__(self, function: Function, arguments: Any, references: Sequence[Any]) -> None:
        self._function = function
        (tables, self._numbers, self._rows), remaining = arguments, iter(references)
        leaves, structure = jax.tree.flatten(tables)
        kept = [
            _Table(next(remaining), next(remaining) if _has_words(leaf) else None, leaf.shape)
            for leaf in leaves
        ]
        self._tables = jax.tree.unflatten(structure, kept)
        self._references = list(remaining)

    def evaluate(self, row: jax.Array, group: jax.Array, some: jax.Array) -> Any:
        """Evaluates the function for rows of groups; where `some` is False, for zeros."""
        from jax.experimental.pallas import triton

        def load(reference: Any, size: int, row: jax.Array) -> tuple[jax.Array, ...]:
            zero = np.zeros((), reference.dtype)
            return tuple(
                triton.load(reference.at[size * row + k], mask=some, other=zero)
                for k in range(size)
            )

        arrays = [*(() if self._numbers is None else (self._numbers,)), *self._rows]
        with no_barriers():
            columns = [
                load(reference, array.shape[-1], group if array is self._numbers else row)
                for reference, array in zip(self._references, arrays, strict=True)
            ]
            return self._function(self._tables, *columns)


def _call(
    body: Callable[[_Inputs, Any, jax.Array], None],
    function: Function,
    arguments: Any,
    shapes: Sequence[jax.ShapeDtypeStruct],
    *,
    programs: int,
    warps: int,
) -> list[jax.Array]:
    """Starts a kernel that reads and writes raveled arrays."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    tables, *others = arguments
    arrays = []
    for leaf in jax.tree.leaves(tables):
        arrays += [leaf, _words_of(leaf)] if _has_words(leaf) else [leaf]
    arrays += jax.tree.leaves(others)

    def entry(*references: Any) -> None:
        inputs = _Inputs(function, arguments, references[: len(arrays)])
        body(inputs, references[len(arrays) :], pl.program_id(0))

    anywhere = pl.BlockSpec(memory_space=pl.ANY)
    found = pl.pallas_call(
        entry,
        grid=(programs,),
        in_specs=[anywhere] * len(arrays),
        out_specs=[anywhere] * len(shapes),
        out_shape=[jax.ShapeDtypeStruct((shape.size,), shape.dtype) for shape in shapes],
        interpret=bool(INTERPRET),
        compiler_params=triton.CompilerParams(num_warps=warps),
        name="by_points",
    )(*(array.ravel() for array in arrays))
    return [array.reshape(shape.shape) for array, shape in zip(found, shapes, strict=True)]


def _has_words(table: jax.Array) -> bool:
    """Returns whether short numbers fill whole words of 32 bits, so that no copy is needed."""
    return table.dtype in (jnp.int8, jnp.int16, jnp.float16) and table.nbytes % 4 == 0


def _words_of(table: jax.Array) -> jax.Array:
    """Returns the same memory as int32 numbers."""
    parts = table.reshape(-1, 4 // table.dtype.itemsize)
    return jax.lax.bitcast_convert_type(parts, jnp.int32)


class _Table:
    """A table in the GPU's memory.

    It is read by one array of indices, after `ravel` or `reshape`, or by `vectors.take`.
    """

    def __init__(self, reference: Any, words: Any, shape: tuple[int, ...]) -> None:
        self._reference, self._words = reference, words
        self.shape, self.dtype = shape, reference.dtype

    def ravel(self) -> _Table:
        return self.reshape(-1)

    def reshape(self, *shape: int) -> _Table:
        total, given = math.prod(self.shape), math.prod(size for size in shape if size >= 0)
        shape = tuple(total // given if size < 0 else size for size in shape)
        return _Table(self._reference, self._words, shape)

    def __getitem__(self, index: jax.Array) -> jax.Array:
        # No index reads beyond the table, whatever a map holds.
        return self._reference[jnp.clip(index.astype(jnp.int32), 0, math.prod(self.shape) - 1)]

    def gather(self, rows: jax.Array, first: int) -> Vector:
        """Gathers as `vectors.take` does.

        Reads are what takes the time. Three short numbers in a row lie in two words of 32 bits: a
        million returns are compared with a map in 0.39 instead of 0.46 ms.
        """
        start = rows.astype(jnp.int32) * self.shape[1] + first
        size, bits = math.prod(self.shape), 8 * self.dtype.itemsize
        if self._words is None:
            wide = jnp.float32 if jnp.issubdtype(self.dtype, jnp.floating) else jnp.int32
            x, y, z = (self[start + k].astype(wide) for k in range(3))
            return x, y, z
        start = jnp.clip(start, 0, size - 3)
        each = 32 // bits
        word, place = jax.lax.div(start, np.int32(each)), jax.lax.rem(start, np.int32(each))
        last = -(-size // each) - 1
        low, high = self._words[word], self._words[jnp.minimum(word + 1, last)]

        def number(k: int) -> jax.Array:
            part = jnp.where(place + k < each, low, high) >> (bits * ((place + k) & (each - 1)))
            if jnp.issubdtype(self.dtype, jnp.floating):
                half = jax.lax.bitcast_convert_type(part.astype(jnp.int16), self.dtype)
                return half.astype(jnp.float32)
            return (part << (32 - bits)) >> (32 - bits)  # with its sign

        return number(0), number(1), number(2)


def _results_of(function: Function, tables: Any, numbers: Any, rows: Sequence[Any]) -> Any:
    """Returns the shapes of a function's joined results."""
    axes = rows[0].shape[:-1]

    def split(array: Any) -> tuple[jax.ShapeDtypeStruct, ...]:
        return (jax.ShapeDtypeStruct(axes, array.dtype),) * array.shape[-1]

    given = () if numbers is None else (split(numbers),)
    arguments = *given, *map(split, rows)
    results = jax.eval_shape(lambda *all: joined(function(*all)), tables, *arguments)
    assert all(leaf.shape[: len(axes)] == axes for leaf in jax.tree.leaves(results))
    return results


def _is_tuple(value: Any) -> bool:
    return type(value) is tuple and len(value) > 0 and all(hasattr(v, "dtype") for v in value)
