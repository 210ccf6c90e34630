"""The modes of JAX that a caller may have chosen: promotion, Explicit and Manual mesh axes.

The code of this package is written for JAX's defaults. Here it is made independent of them, so that
no expression has to be written for the strictest combination.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, PartitionSpec


def plain[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function independent of the caller's `jax_numpy_*_promotion` modes.

    Args:
        function: A function of arrays, traced or not.

    Returns:
        The same function; it promotes ranks and types as JAX does by default.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            return function(*args, **kwargs)

    return wrapped


def pointwise[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Makes a traced function of points independent of the caller's modes, Explicit axes included.

    In a mesh with Explicit axes, the type of an array says how it is sharded, and a gather must get
    the sharding of its result. The compiler shards these functions itself; the result is sharded
    as the points are.

    Args:
        function: Its second argument is points (..., 3); its results have the axes (...) first.

    Returns:
        The same function.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        mesh = _explicit_mesh(args)
        if mesh is None:
            return plain(function)(*args, **kwargs)
        shardings = jax.typeof(args[1]).sharding
        axes = shardings.spec[:-1] if shardings.mesh == mesh else ()
        with jax.sharding.use_abstract_mesh(mesh):
            automatic: Any = jax.sharding.auto_axes(
                functools.partial(plain(function), **kwargs), out_sharding=PartitionSpec(*axes)
            )
            return automatic(*args)

    return wrapped


def varying_like(start: Any, *others: Any) -> Any:
    """Gives constants that a loop starts from the type that they have after its first round.

    Inside `jax.shard_map` the type of an array says over which axes of the mesh it varies.

    Args:
        start: A pytree of arrays.
        others: Pytrees of the arrays that the loop's body reads.

    Returns:
        The same values, varying over the axes that any of `others` varies over.
    """
    axes = frozenset().union(*map(_varying_axes, jax.tree.leaves(others)))

    def vary(leaf: jax.Array) -> jax.Array:
        missing = tuple(sorted(axes - _varying_axes(leaf)))
        return jax.lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(vary, start) if axes else start


def cond(pred: jax.Array, true: Callable, false: Callable, *operands: Any) -> Any:
    """Calls `jax.lax.cond` with branches of which one may return constants.

    Args:
        pred: Which branch, () bool.
        true: The branch for True.
        false: The branch for False.
        *operands: What the branches take.

    Returns:
        The branch's result, varying over the axes that `pred` or an operand varies over.
    """

    def vary(branch: Callable) -> Callable:
        return lambda *operands: varying_like(branch(*operands), pred, operands)

    return jax.lax.cond(pred, vary(true), vary(false), *operands)


def run_if(pred: jax.Array, function: Callable[[Any], Any], value: Any, *others: Any) -> Any:
    """Applies a function where it is needed, and under `jax.vmap` only if any element needs it.

    There `jax.lax.cond` runs both branches for all elements. The result has no derivatives.

    Args:
        pred: Whether to apply it, () bool.
        function: Maps `value` to values of the same types.
        value: A pytree of arrays.
        others: Pytrees of the other arrays that the function reads.

    Returns:
        The function's result where `pred` holds, else `value`.
    """

    def vary(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        return varying_like(jax.lax.stop_gradient(carry), pred, value, others)

    # XLA must see that the loop runs once at most: else it may do the work before the loop.
    def body(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        return vary((jnp.zeros((), bool), function(carry[1])))

    return jax.lax.while_loop(lambda carry: carry[0], body, vary((pred, value)))[1]


def is_varying(tree: Any) -> bool:
    """Returns whether an array of a pytree varies over axes of the mesh of `jax.shard_map`."""
    return any(map(_varying_axes, jax.tree.leaves(tree)))


def _varying_axes(leaf: jax.Array) -> frozenset[Any]:
    """Returns the axes of the mesh that an array varies over inside `jax.shard_map`."""
    kind: Any = jax.typeof(leaf)
    # jax 0.12 has renamed the attribute.
    return kind.manual_axis_type.varying if hasattr(kind, "manual_axis_type") else kind.vma


def _explicit_mesh(args: Any) -> jax.sharding.AbstractMesh | None:
    """Finds the mesh with Explicit axes that any array of the arguments lies on."""
    for leaf in jax.tree.leaves(args):
        if isinstance(leaf, jax.Array):
            mesh = jax.typeof(leaf).sharding.mesh
            if AxisType.Explicit in mesh.axis_types:
                return mesh
    return None
