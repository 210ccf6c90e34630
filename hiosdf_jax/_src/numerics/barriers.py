"""Barriers that keep XLA from repeating work."""

from __future__ import annotations

import contextlib
import contextvars
import functools
from collections.abc import Iterator
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero

_barred = contextvars.ContextVar("_barred", default=True)


@contextlib.contextmanager
def no_barriers() -> Iterator[None]:
    """Leaves barriers out of what is traced: in our kernels, all is computed once."""
    token = _barred.set(False)
    try:
        yield
    finally:
        _barred.reset(token)


def compute_once(tree: Any) -> Any:
    """Has arrays computed once, however many others are computed from them.

    On a CPU, XLA makes one kernel of an array and all that leads to it, and repeats this in each
    kernel that reads the array, gathers included. A GPU gains from the fewer kernels.

    Args:
        tree: A pytree of arrays. In reverse mode either all or none of them may have tangents.

    Returns:
        The same values. Differentiable.
    """
    if jax.default_backend() != "cpu":
        return tree
    return _barrier(tree)


def hold(tree: Any) -> Any:
    """Has arrays computed by kernels of their own on a GPU.

    There XLA may otherwise compute them again in each kernel that reads them.

    Args:
        tree: A pytree of arrays.

    Returns:
        The same values. Differentiable.
    """
    if jax.default_backend() == "cpu":
        return tree
    return _barrier(tree)


@jax.custom_jvp
def differentiate_once(tree: Any) -> Any:
    """Returns arrays; derivatives by them are computed once, however many others need them.

    On all devices, XLA makes one kernel of an array and all that leads to it. Where derivatives by
    three components are joined to vectors, it would compute all three for each number.

    Args:
        tree: A pytree of arrays.

    Returns:
        The same arrays. Differentiable any number of times.
    """
    return tree


@functools.partial(differentiate_once.defjvp, symbolic_zeros=True)
def _differentiate_once_jvp(primals: Any, tangents: Any) -> Any:
    leaves, structure = jax.tree.flatten(tangents[0])
    given = [not isinstance(leaf, SymbolicZero) for leaf in leaves]
    kept = iter(_barrier([t for t, g in zip(leaves, given, strict=True) if g]))
    held = [next(kept) if g else t for t, g in zip(leaves, given, strict=True)]
    return primals[0], jax.tree.unflatten(structure, held)


def _barrier(tree: Any) -> Any:
    return jax.lax.optimization_barrier(tree) if _barred.get() else tree
