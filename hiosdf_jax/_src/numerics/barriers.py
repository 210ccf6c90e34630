"""Barriers that keep XLA from repeating work."""

from __future__ import annotations

from typing import Any

import jax


def compute_once(tree: Any) -> Any:
    """Has arrays computed once, however many others are computed from them.

    On a CPU, XLA makes one kernel of an array and all that leads to it, and repeats this in each
    kernel that reads the array, gathers included. A GPU gains from the fewer kernels.

    Args:
        tree: A pytree of arrays.

    Returns:
        The same values. Differentiable.
    """
    if jax.default_backend() != "cpu":
        return tree
    return jax.lax.optimization_barrier(tree)


@jax.custom_jvp
def differentiate_once(tree: Any) -> Any:
    """Has derivatives by arrays computed once, however many others are computed from them.

    Where three components are joined to vectors, XLA makes one kernel of the join and all that
    leads to it. For each number of the result it would compute the derivatives by all three.

    Args:
        tree: A pytree of arrays.

    Returns:
        The same arrays. Differentiable.
    """
    return tree


@differentiate_once.defjvp
def _differentiate_once_jvp(primals: Any, tangents: Any) -> Any:
    return primals[0], jax.lax.optimization_barrier(tangents[0])
