"""Each voxel's nearest site, by one exact distance transform per axis.

A transform takes the minimum over all sites within the horizon of a squared distance. A site lies
at the center of its patch, not at that of its voxel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.barriers import hold
from hiosdf_jax._src.numerics.loops import rounds_per_step
from hiosdf_jax._src.numerics.modes import varying_like
from hiosdf_jax._src.numerics.shifts import pad_axis

_INFINITE = 1e12  # squared voxels

# On a GPU, an array of up to this many distances, of all sets of sites, is taken for that of one of
# many maps, see `_transform_twice`. An update of 1,024 maps of 32,000 voxels, with two sets each,
# takes 33.3 instead of 36.4 ms on an H200 with it.
_SMALL = 200_000
_ROUNDING = 1e-6  # of squared distances

# A CPU transforms blocks of about this many voxels one after the other, so that they stay in its
# cache. Blocks of 100,000 take 1.16 times as long, blocks of 6,000 1.26 times. A GPU transforms all
# voxels at once.
_BLOCK = 12_000


class Part(NamedTuple):
    """A box of voxels in an array.

    Attributes:
        start: Its first voxel, three int32 scalars.
        shape: Its shape, static.
    """

    start: tuple[jax.Array | np.int32 | int, ...]
    shape: tuple[int, ...]


def nearest_sites(
    sites: jax.Array,
    offset: jax.Array,
    horizon: int,
    part: Part | None = None,
    order: Sequence[int] = (2, 1, 0),
) -> tuple[jax.Array, jax.Array]:
    """Finds each voxel's nearest site, for several sets of sites at once.

    Args:
        sites: Masks of the voxels that hold a site, (S, X, Y, Z) bool.
        offset: Offset of the site from its voxel's center, (X, Y, Z, 3) voxels, in [-0.5, 0.5].
        horizon: Largest distance along an axis, voxels.
        part: The voxels to find sites for; all by default.
        order: Order of the axes. Each transform cuts the box down to the part along its axis. The
            result can depend on the order where sites lie off their voxels' centers.

    Returns:
        nearest: Flat index of the nearest site's voxel, (S, A, B, C) int32, of the part's shape; -1
            where none is within the horizon.
        squared: Squared distance of the voxel's center to it, (S, A, B, C) voxels^2.
    """
    start, size = part or Part((0, 0, 0), sites.shape[1:])
    squared = jnp.where(sites, jnp.sum(offset * offset, axis=-1), _INFINITE)
    nearest = None
    for axis in order:
        # A voxel's candidate, at first its own site, lies at another place along this axis.
        along = offset[..., axis]
        along = jnp.broadcast_to(along, sites.shape) if nearest is None else _gather(along, nearest)
        before = squared.shape
        squared, shift = _transform_axis(squared, along, axis + 1, horizon, start[axis], size[axis])
        chosen = _chosen(before, shift, axis + 1, start[axis])
        own = chosen % math.prod(before[1:])
        nearest = own if nearest is None else _gather(nearest, chosen)
    assert nearest is not None, "no axis in order"
    found = squared <= horizon**2
    return jnp.where(found, nearest, -1), jnp.where(found, squared, _INFINITE)


def _gather(values: jax.Array, index: jax.Array) -> jax.Array:
    """Takes values at flat indices; unsigned ones need no check for negative numbers."""
    return values.ravel()[index.astype(jnp.uint32)]


def _chosen(
    shape: tuple[int, ...], shift: jax.Array, axis: int, first: jax.Array | np.int32 | int
) -> jax.Array:
    """Returns flat indices of the voxels that lie `shift` voxels away along an axis.

    Args:
        shape: Shape of the array (S, X, Y, Z) that the indices are for.
        shift: Shifts from the voxels of a part of it, int32.
        axis: The axis, along which the part begins at `first`.
        first: The first voxel.

    Returns:
        int32, of the shape of `shift`.
    """
    index = [jax.lax.broadcasted_iota(jnp.int32, shift.shape, k) for k in range(len(shape))]
    index[axis] = index[axis] + first + shift
    flat = jnp.zeros(shift.shape, jnp.int32)
    for size, place in zip(shape, index, strict=True):
        flat = flat * size + place
    return flat


def _transform_axis(
    squared: jax.Array,
    along: jax.Array,
    axis: int,
    horizon: int,
    first: jax.Array | np.int32 | int,
    length: int,
) -> tuple[jax.Array, jax.Array]:
    """Finds the least squared distance over shifts along an axis, for `length` voxels of it.

    The candidate of the voxel k further along is at k + along from here. Its distance across the
    axis is the same as there.

    Args:
        squared: Squared distance to each voxel's candidate, (S, X, Y, Z) voxels^2.
        along: Offset of the candidate along the axis, (S, X, Y, Z) voxels.
        axis: The axis.
        horizon: Largest shift, voxels.
        first: First voxel along the axis.
        length: Voxels along the axis, static.

    Returns:
        The least squared distances and the shifts that give them, int32.
    """
    shape = squared.shape
    rows = (math.prod(shape[:axis]), shape[axis], math.prod(shape[axis + 1 :]))
    squared, along = squared.reshape(rows), along.reshape(rows)
    across = 0 if rows[0] >= rows[2] else 2  # the axis to divide into blocks
    cut = (*shape[:axis], length, *shape[axis + 1 :])
    if jax.default_backend() != "cpu":  # a loop over a single block takes eight times as long
        best, shift = _transform_block(squared, along, horizon, first, length)
        return best.reshape(cut), shift.reshape(cut)
    blocks = -(-squared.size // _BLOCK)
    size = -(-rows[across] // min(blocks, rows[across]))
    blocks = -(-rows[across] // size)

    def transform(block: jax.Array, results: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        # The last block overlaps the one before it.
        begin = jnp.minimum(block * size, rows[across] - size)
        near = jax.lax.dynamic_slice_in_dim(squared, begin, size, across)
        offset = jax.lax.dynamic_slice_in_dim(along, begin, size, across)
        found = _transform_block(near, offset, horizon, first, length)
        return tuple(
            jax.lax.dynamic_update_slice_in_dim(old, new, begin, across)
            for old, new in zip(results, found, strict=True)
        )

    whole = (rows[0], length, rows[2])
    results = (jnp.zeros(whole, squared.dtype), jnp.zeros(whole, jnp.int32))
    results = varying_like(results, squared, along)
    best, shift = jax.lax.fori_loop(0, blocks, transform, results)
    return best.reshape(cut), shift.reshape(cut)


def _transform_block(
    squared: jax.Array,
    along: jax.Array,
    horizon: int,
    first: jax.Array | np.int32 | int,
    length: int,
) -> tuple[jax.Array, jax.Array]:
    """Does the same for an array (A, N, B) along its middle axis."""
    reach = min(horizon, squared.shape[1] - 1)
    # Otherwise XLA computes the candidates and their margins again for each shift, where it unrolls
    # the loop. On an H100 the sites of 1,024 small maps take 14 ms, and 22 ms without held margins.
    squared, along = jax.lax.optimization_barrier((squared, along))
    across = pad_axis(squared - along * along, 1, reach, _INFINITE).part(first, length).held()
    along_axis = pad_axis(along, 1, reach).part(first, length).held()
    best = jax.lax.dynamic_slice_in_dim(squared, first, length, 1)

    def candidate(step: jax.Array) -> jax.Array:
        return across.shifted(step) + (step + along_axis.shifted(step)) ** 2

    if jax.default_backend() != "cpu" and best.size <= _SMALL:
        return _transform_twice(candidate, varying_like(best, squared, along), reach)

    def compare(k: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        best, shift = found
        for step in (-k, k):
            other = candidate(step)
            shift = jnp.where(other < best, step, shift)
            best = jnp.minimum(best, other)
        return best, shift

    start = varying_like((best, jnp.zeros(best.shape, jnp.int32)), squared, along)
    return jax.lax.fori_loop(
        np.int32(1), np.int32(reach + 1), compare, start, unroll=rounds_per_step()
    )


def _transform_twice(
    candidate: Callable[[jax.Array], jax.Array], own: jax.Array, reach: int
) -> tuple[jax.Array, jax.Array]:
    """Finds the least candidates first, and then their shifts.

    XLA makes one kernel of several rounds of a loop that has one result. Of a loop with two results
    it stores parts of each round, for all of many small maps. One large map gains nothing.

    Args:
        candidate: Maps a shift to the candidates that lie there.
        own: The candidates at shift 0.
        reach: Largest shift.

    Returns:
        The least candidates, and the shortest shifts that give them but for rounding errors, int32.
    """

    def compare(k: jax.Array, least: jax.Array) -> jax.Array:
        return jnp.minimum(least, jnp.minimum(candidate(-k), candidate(k)))

    def choose(number: jax.Array, shift: jax.Array) -> jax.Array:
        k = reach - number
        shift = jnp.where(candidate(k) <= most, k, shift)
        return jnp.where(candidate(-k) <= most, -k, shift)

    loop = functools.partial(jax.lax.fori_loop, unroll=rounds_per_step())
    least = hold(loop(np.int32(1), np.int32(reach + 1), compare, own))
    most = least + _ROUNDING * (jnp.abs(least) + 1)
    start = varying_like(jnp.zeros(least.shape, jnp.int32), least)
    shift = loop(np.int32(0), np.int32(reach), choose, start)
    return least, jnp.where(own <= most, 0, shift)
