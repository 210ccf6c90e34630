"""Functions of many points, evaluated tile by tile however a caller batches them.

`jax.vmap` over points makes more rows of one evaluation. So a planner that is written for one point
is as fast as one that is written for a batch, and needs no more memory. Several fields, derivatives
by the field and second derivatives are evaluated as a whole.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.tangents import all_zero, instantiate
from hiosdf_jax._src.numerics.tiles import map_tiles

# Rows of a tile. From 1,024 to 8,192 are equally fast.
_LARGEST = 4096

Evaluate = Callable[[Any, jax.Array], Any]


def by_rows(function: Evaluate, with_gradient: Evaluate | None = None) -> Evaluate:
    """Evaluates a function of a field and points tile by tile.

    Measured on two cores with 1,048,576 points: `sdf` takes 0.7 and `sdf_and_grad` 0.6 of the time.

    Args:
        function: Maps a pytree and points (..., 3) to arrays with the axes (...) first. Each row of
            the result depends on its own point only.
        with_gradient: If the result is one array (...): computes it and its gradient by the points,
            (..., 3), for the derivatives by the points alone.

    Returns:
        The same function. Differentiable as `function` is.
    """
    tiled = custom_vmap(
        lambda field, points: map_tiles(functools.partial(function, field), points, _LARGEST)
    )

    @tiled.def_vmap
    @plain  # traced again when a caller batches it, in the caller's modes
    def of_batch(size: int, batched: Any, field: Any, points: jax.Array) -> Any:
        if any(jax.tree.leaves(batched[0])):  # several fields
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
            result = jax.vmap(function, axes)(field, points)
        else:
            result = tiled(field, points)
        return result, jax.tree.map(lambda _: True, result)

    evaluate = jax.custom_jvp(lambda field, points: tiled(field, points))

    @functools.partial(evaluate.defjvp, symbolic_zeros=True)
    @plain
    def _(primals: Any, tangents: Any) -> Any:
        tangents_all = instantiate(primals, tangents)
        if with_gradient is None or not all_zero(tangents[0]):
            return jax.jvp(function, primals, tangents_all)
        value, gradient = with_gradient(*primals)
        return value, jnp.sum(gradient * tangents_all[1], axis=-1)

    return evaluate
