"""Tangents that a custom derivative gets, some of them symbolic zeros."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero


def all_zero(tangents: Any) -> bool:
    """Returns whether all tangents of a pytree are known to be zero."""
    return all(map(_is_zero, jax.tree.leaves(tangents)))


def instantiate(primals: Any, tangents: Any) -> Any:
    """Replaces symbolic zeros by arrays of zeros.

    Args:
        primals: A pytree of arrays.
        tangents: Their tangents.

    Returns:
        The tangents.
    """

    def one(primal: Any, tangent: Any) -> Any:
        if not _is_zero(tangent):
            return tangent
        if jnp.issubdtype(primal.dtype, jnp.inexact):
            return jnp.zeros_like(primal)
        return np.zeros(primal.shape, jax.dtypes.float0)

    return jax.tree.map(one, primals, tangents)


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero) or tangent.dtype == jax.dtypes.float0
