"""Returns compared with a map: rows, their residuals at a pose, and sums over them.

Rotations are measured in meters, as the distance by which a return at the cloud's typical range
moves. So all six components of a motion have one unit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.mapping.registration.matching import (
    Match,
    between,
    match_at,
    match_baked,
    share_of_map,
)
from hiosdf_jax._src.mapping.registration.selection import even_steps
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.point_kernel import by_points, columns, joined, sum_by_points
from hiosdf_jax._src.numerics.vectors import Vector, cross, dot, each
from hiosdf_jax._src.state.pytrees import Baked, Field, Surface

GROWING_REACH_M = 0.2
"""How far surfaces may be from where they should be, in a map that grows."""

INLIER_DEVIATIONS = 3.0
"""Returns within this many standard deviations of a surface lie on it."""

# The weight of a return falls to a quarter at this many standard deviations: in a complete map, and
# in one that grows. There, patches that were hit a few times are off by more than their spread.
_OUTLIER_DEVIATIONS = INLIER_DEVIATIONS, 1.5

# No patch is known better than this, m, and no return across its ray better than this, rad: pixels
# and laser beams are that wide. Without it distant surfaces at grazing angles count too much.
_LEAST_SIGMA_M = 0.006
_ACROSS_RAD = 0.002

# Returns this deep in unseen space are compared, m, and this many times what a coarse scale has
# above the reach in a map that grows. There, a return in unseen space is of a surface that the map
# does not have.
_DEEPEST_M = 0.1
_DEEPEST_SCALES = 2.0

LOWER = [(i, j) for i in range(6) for j in range(i + 1)]
"""Rows and columns of the lower half of a symmetric matrix (6, 6)."""

# Enough for coarse steps, for principal directions, and to judge a pose.
_EVEN_ROWS = 1024

# Typical ranges are limited to this, m, so that rotations keep a sensible weight.
_RANGES_M = (0.5, 20.0)


class Rows(NamedTuple):
    """The returns that are used.

    Attributes:
        points: (N, 3) m, sensor frame.
        sigma: Standard deviation of the range, (N,) m.
        some: The row is a return, (N,) bool.
        length: Typical range, () m: a rotation by 1 rad counts as this many meters.
        growing: How incomplete the map is, () from 0 to 1: a return may be of a new surface.
        share: How far distances are the map's own, () from 0 to 1; see `matching.share_of_map`. It
            is 1 until it is measured.
    """

    points: jax.Array
    sigma: jax.Array
    some: jax.Array
    length: jax.Array
    growing: jax.Array
    share: jax.Array


class Residuals(NamedTuple):
    """The returns at a pose, compared with the map.

    Attributes:
        distance: Signed distances, (N,) m.
        jacobian: Their derivative by the motion, (N, 6).
        sigma: Standard deviation of each, (N,) m.
        comparable: The map has observed the place, (N,) bool.
        contrary: The map has seen it empty, (N,) bool.
        weight: Inverse variance, less for outliers, 0 where nothing can be compared, (N,).
        points_world: (N, 3) m.
        width: As in `matching.Match`, (N,) voxels.
    """

    distance: jax.Array
    jacobian: jax.Array
    sigma: jax.Array
    comparable: jax.Array
    contrary: jax.Array
    weight: jax.Array
    points_world: jax.Array
    width: jax.Array


def make_rows(
    points: jax.Array,
    some: jax.Array,
    noise: tuple[jax.Array, jax.Array],
    growing: jax.Array | float = 0.0,
) -> Rows:
    """Prepares returns.

    Args:
        points: (N, 3) m, sensor frame, finite.
        some: The row is a return, (N,) bool.
        noise: (a, b) of the standard deviation a + b r^2 at range r, m and 1/m.
        growing: See `Rows`.

    Returns:
        The rows.
    """
    square = jnp.sum(points**2, axis=-1)
    mean = jnp.sum(jnp.where(some, square, 0)) / jnp.maximum(jnp.sum(some), 1)
    length = jnp.clip(jnp.sqrt(jnp.maximum(jax.lax.stop_gradient(mean), 1e-6)), *_RANGES_M)
    sigma = noise[0] + noise[1] * square
    growing = jnp.asarray(growing, jnp.float32)
    return Rows(points, sigma, some, length, growing, jnp.ones((), jnp.float32))


def take_rows(rows: Rows, index: jax.Array | slice) -> Rows:
    """Selects some of the rows; what holds for the whole cloud stays."""
    return rows._replace(points=rows.points[index], sigma=rows.sigma[index], some=rows.some[index])


def even_index(rows: Rows, count: int = _EVEN_ROWS) -> jax.Array:
    """Selects returns at even steps, or all if there are fewer; the rows begin with the returns."""
    count = min(count, rows.points.shape[0])
    return even_steps(jnp.sum(rows.some), count).astype(jnp.int32)


def take_evenly(rows: Rows, count: int = _EVEN_ROWS) -> Rows:
    """Returns the rows of `even_index`."""
    return take_rows(rows, even_index(rows, count))


def units(rows: Rows) -> jax.Array:
    """Returns the meters per unit of each component of a motion, (6,)."""
    return jnp.concatenate([jnp.ones(3, jnp.float32), jnp.full(3, rows.length, jnp.float32)])


def compare(
    field: Field | Baked, rows: Rows, pose: jax.Array, scale_m: jax.Array | float
) -> Residuals:
    """Compares returns with a map.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4) T_world_sensor.
        scale_m: How far surfaces may be from where they should be; 0 for the last, fine steps.

    Returns:
        The residuals.
    """
    arguments, numbers = _arguments(rows, pose, scale_m)
    if isinstance(field, Field):
        return by_points(_compare_at, field.config, field.surface, *arguments, numbers=numbers)

    def match(point_world: Vector, *_: Any) -> Match:
        return match_baked(field, point_world)

    return joined(_residuals_at(match, columns(numbers), *map(columns, arguments)))


def sum_returns(
    field: Field | Baked, rows: Rows, pose: jax.Array, scale_m: jax.Array | float
) -> Sums:
    """Computes `sums_of` the residuals of `compare`.

    One kernel does it on a Hopper GPU. Elsewhere the residuals are made first, so that each return
    is looked up once.
    """
    if isinstance(field, Baked) or not devices.has_kernels():
        return sums_of(compute_once(compare(field, rows, pose, scale_m)))
    arguments, numbers = _arguments(rows, pose, scale_m)
    return Sums(sum_by_points(_terms_at, field.config, field.surface, *arguments, numbers=numbers))


def _arguments(
    rows: Rows, pose: jax.Array, scale_m: jax.Array | float
) -> tuple[tuple[jax.Array, ...], jax.Array]:
    """Returns what `_residuals_at` takes: arrays of rows (N, K), and numbers."""
    scalars = jnp.stack([jnp.float32(scale_m), rows.share, rows.growing, rows.length])
    returns = rows.points, rows.sigma[:, None], rows.some[:, None]
    return returns, jnp.concatenate([pose[:3].ravel(), scalars])


def _compare_at(config: Config, surface: Surface, *arguments: Any) -> Any:
    return _residuals_at(partial(match_at, config, surface), *arguments)


def _terms_at(config: Config, surface: Surface, *arguments: Any) -> tuple[jax.Array, ...]:
    """Computes what each return adds to the sums."""
    found = _compare_at(config, surface, *arguments)
    weighted = [found.weight * part for part in found.jacobian]
    information = [weighted[i] * found.jacobian[j] for i, j in LOWER]
    slope = [part * found.distance for part in weighted]
    others = [part.astype(jnp.float32) for part in _others_of(found)]
    return (*information, *slope, *others)


def _residuals_at(
    match: Callable[..., Match], numbers: Any, point: Any, sigma: Any, some: Any
) -> Any:
    """Computes `compare` for returns whose columns are given, and columns instead of arrays.

    Args:
        match: `match_at` of a map.
        numbers: The rows of the pose, the scale, m, and three attributes of `Rows`.
        point: (...) m each, sensor frame.
        sigma: As in `Rows`, a tuple of one array (...).
        some: As in `Rows`, a tuple of one array (...).

    Returns:
        The residuals.
    """
    transform, (scale_m, share, growing, length) = numbers[:12], numbers[12:]
    offset = each(lambda row: dot(transform[row : row + 3], point), (0, 4, 8))
    point_world = each(jnp.add, offset, transform[3::4])
    found = match(point_world, offset, growing, share, sigma[0])
    # Only the part of the error along the normal counts.
    square = jnp.maximum(dot(offset, offset), 1e-6)
    along = jnp.minimum(dot(found.normal, offset) ** 2 / square, 1)
    variance = along * sigma[0] ** 2 + (1 - along) * _ACROSS_RAD**2 * square
    variance += found.spread**2 + _LEAST_SIGMA_M**2
    deepest = jnp.maximum(_DEEPEST_M, _DEEPEST_SCALES * (scale_m - GROWING_REACH_M))
    comparable = some[0] & found.usable & (found.depth < deepest)
    whole, weight = _tolerant(found.distance, variance, comparable, growing, scale_m)
    lever = each(lambda part: part / length, cross(offset, found.normal))
    jacobian: Any = (*found.normal, *lever)
    points_world: Any = point_world
    return Residuals(
        distance=found.distance,
        jacobian=jacobian,
        sigma=whole,
        comparable=comparable,
        contrary=some[0] & found.empty,
        weight=weight,
        points_world=points_world,
        width=jnp.where(some[0], found.width, 0),
    )


def _tolerant(
    distance: jax.Array, variance: jax.Array, comparable: jax.Array, growing: Any, scale_m: Any
) -> tuple[jax.Array, jax.Array]:
    """Computes `Residuals.sigma` and `Residuals.weight` where surfaces may be `scale_m` off."""
    deviations = between(_OUTLIER_DEVIATIONS, growing)
    whole = jnp.sqrt(variance + (scale_m / deviations) ** 2)
    # The function of Geman and McClure.
    ratio = distance / (deviations * whole)
    return whole, jnp.where(comparable, 1 / (whole * (1 + ratio**2)) ** 2, 0)


def tolerate(residuals: Residuals, rows: Rows, scale_m: float) -> Residuals:
    """Returns residuals as `compare` gives them with a tolerance, from those without one.

    Args:
        residuals: The rows at a pose, compared with a scale of 0.
        rows: The rows.
        scale_m: As for `compare`, at most `GROWING_REACH_M`.

    Returns:
        The residuals.
    """
    sigma, weight = _tolerant(
        residuals.distance, residuals.sigma**2, residuals.comparable, rows.growing, scale_m
    )
    return residuals._replace(sigma=sigma, weight=weight)


class Sums(NamedTuple):
    """What steps need of all returns together.

    Attributes:
        values: All sums in one array, (31,), so that one copy moves them.
    """

    values: jax.Array

    @property
    def information(self) -> jax.Array:
        """Lower half of the information matrix, row by row, (21,) 1/m^2."""
        return self.values[:21]

    @property
    def slope(self) -> jax.Array:
        """Slope of half the weighted sum of squares by the motion, (6,) 1/m."""
        return self.values[21:27]

    @property
    def loss(self) -> jax.Array:
        """Sum of the losses of the returns that the map can judge, ()."""
        return self.values[27]

    @property
    def known(self) -> jax.Array:
        """Number of the returns that the map can judge, ()."""
        return self.values[28]

    @property
    def share(self) -> jax.Array:
        """How far distances are the map's own at this pose; see `matching.share_of_map`."""
        return share_of_map(self.values[29], self.values[30])


def measure_share(field: Field | Baked, rows: Rows, pose: jax.Array) -> Rows:
    """Measures `Rows.share` where returns are at a pose (4, 4)."""
    return rows._replace(share=sum_returns(field, rows, pose, 0.0).share)


def sums_of(residuals: Residuals) -> Sums:
    """Sums residuals over the returns."""
    information, slope = normal_equations(residuals)
    rows, lower = zip(*LOWER, strict=True)
    others = _others_of(residuals)
    return Sums(
        jnp.concatenate(
            [
                information[np.array(rows), np.array(lower)],
                slope,
                jnp.stack([jnp.sum(part.astype(jnp.float32)) for part in others]),
            ]
        )
    )


def no_sums() -> Sums:
    """Returns the sums of no returns."""
    return Sums(jnp.zeros(31, jnp.float32))


def _others_of(residuals: Residuals) -> tuple[jax.Array, ...]:
    """Returns what `Sums` sums after the slope, (N,) each."""
    known = residuals.comparable | residuals.contrary
    return _loss_of(residuals), known, residuals.width, residuals.width > 0


def normal_equations(residuals: Residuals) -> tuple[jax.Array, jax.Array]:
    """Computes the normal equations of independent returns.

    Args:
        residuals: The returns at a pose.

    Returns:
        The information matrix, (6, 6) 1/m^2, and the slope of half the weighted sum of squares by
        the motion, (6,) 1/m.
    """
    weighted = residuals.weight[:, None] * residuals.jacobian
    values = jnp.concatenate([residuals.jacobian, residuals.distance[:, None]], axis=-1)
    sums = jnp.matmul(weighted.T, values, precision="highest")
    return sums[:, :6], sums[:, 6]


def information_of(residuals: Residuals) -> jax.Array:
    """Computes the information matrix of independent returns, (6, 6) 1/m^2."""
    return normal_equations(residuals)[0]


def slope_of(residuals: Residuals) -> jax.Array:
    """Computes the slope of half the weighted sum of squares by the motion, (6,) 1/m."""
    return normal_equations(residuals)[1]


def loss_of_distance(residuals: Residuals) -> jax.Array:
    """The loss of Geman and McClure, (N,), from 0 to 1."""
    square = (residuals.distance / (INLIER_DEVIATIONS * residuals.sigma)) ** 2
    return square / (1 + square)


def _loss_of(residuals: Residuals) -> jax.Array:
    """The losses of returns in a fit, (N,): 1 for one that contradicts the map."""
    return jnp.where(
        residuals.comparable, loss_of_distance(residuals), jnp.where(residuals.contrary, 1.0, 0)
    )
