"""Barriers that keep XLA from repeating work on a CPU."""

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
