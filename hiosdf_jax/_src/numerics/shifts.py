"""Shifted copies of an array along an axis, for separable distance transforms."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.barriers import hold
from hiosdf_jax._src.numerics.modes import cond


class Padded(NamedTuple):
    """An array with a margin at both ends of one axis.

    Attributes:
        values: The array with its margins.
        axis: The padded axis.
        reach: Width of each margin, the largest possible shift.
    """

    values: jax.Array
    axis: int
    reach: int

    def shifted(self, shift: jax.Array | int) -> jax.Array:
        """Returns the array whose element i is element i + shift, without the margins."""
        size = self.values.shape[self.axis] - 2 * self.reach
        first = self.reach + shift
        return jax.lax.dynamic_slice_in_dim(self.values, first, size, self.axis)

    def part(self, first: jax.Array | np.int32 | int, size: int) -> Padded:
        """Cuts the array down to `size` elements from `first` on, which need not be static."""
        values = jax.lax.dynamic_slice_in_dim(self.values, first, size + 2 * self.reach, self.axis)
        return self._replace(values=values)

    def computed_once(self) -> Padded:
        """Has the array computed once on a GPU, where a step of a loop reads many shifts of it.

        A CPU takes one shift per step; there the frontier would take 1.2 times as long.
        """
        return self._replace(values=hold(self.values))


def pad_axis(array: jax.Array, axis: int, reach: int, fill: float = 0) -> Padded:
    """Pads an array along an axis.

    Args:
        array: Any shape.
        axis: The axis.
        reach: Elements to add at each end.
        fill: Their value.

    Returns:
        The padded array.
    """
    margin = [(0, 0)] * array.ndim
    margin[axis] = (reach, reach)
    return Padded(jnp.pad(array, margin, constant_values=fill), axis, reach)


def with_neighbors(mask: jax.Array) -> jax.Array:
    """Returns a mask of the voxels at most one voxel away from those of a mask (X, Y, Z)."""

    def grow(mask: jax.Array) -> jax.Array:
        for axis in range(mask.ndim):
            padded = pad_axis(mask, axis, 1, False)
            mask = mask | padded.shifted(-1) | padded.shifted(1)
        return mask

    return cond(jnp.any(mask), grow, lambda mask: mask, mask)


def count_around(mask: jax.Array, reach: int) -> jax.Array:
    """Counts the voxels of a mask in the cube around each voxel.

    Args:
        mask: (X, Y, Z) bool. Voxels outside of it count as False.
        reach: Half the edge of the cube, without the voxel itself; at most 15.

    Returns:
        (X, Y, Z) int16.
    """
    counts = mask.astype(jnp.int16)
    for axis in range(mask.ndim):
        padded = pad_axis(counts, axis, reach)
        counts = sum(
            (padded.shifted(k) for k in range(1 - reach, reach + 1)), padded.shifted(-reach)
        )
    return counts
