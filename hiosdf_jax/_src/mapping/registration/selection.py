"""Which returns of a cloud are used: few, but enough for each direction of the pose."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.masks import count_below, running_sum
from hiosdf_jax._src.numerics.rigid import FARTHEST_M
from hiosdf_jax._src.numerics.small_matrices import solve_positive

# Share of the rows that are drawn evenly. The others are drawn by what they tell of the pose.
_EVEN_SHARE = 0.2

_SIZE_BITS = 4  # of the size of a padded cloud that may be set


def draw_evenly(cloud: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Selects finite rows of a cloud at even steps.

    Args:
        cloud: (N, 3) m; a row with a NaN or inf is not a return.
        count: Most rows to select.

    Returns:
        The rows (min(N, count), 3) m, 0 where there is none, and a mask (min(N, count),) of those
        that are returns. Rows that are not returns do not change which others are selected.
    """
    finite = jnp.all(jnp.isfinite(cloud), axis=-1)
    count = min(count, cloud.shape[0])
    rank = running_sum(finite.astype(jnp.int32))
    total = rank[-1]
    row = count_below(rank, even_steps(total, count).astype(jnp.int32) + 1)
    some = jnp.arange(count) < total
    row = jnp.where(some, jnp.minimum(row, cloud.shape[0] - 1), 0)
    return jnp.where(some[:, None], cloud[row], 0), some


def draw_returns(cloud: jax.Array, least_range_m: float, count: int) -> tuple[jax.Array, jax.Array]:
    """Selects returns as `draw_evenly` does; a cloud (N, 3), m, may be empty."""
    if cloud.shape[0] == 0:
        cloud = jnp.full((1, 3), jnp.nan, jnp.float32)
    returns = are_returns(jnp.sum(cloud**2, axis=-1), least_range_m)
    return draw_evenly(jnp.where(returns[:, None], cloud, jnp.nan), count)


def square_ranges_on_host(cloud: np.ndarray) -> np.ndarray:
    """Returns the squared ranges (N,) of the rows of a cloud (N, 3), m, or what is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        # A product of matrices takes half the time of sums of columns.
        return (cloud * cloud) @ np.ones(3, np.float32)


def are_returns(square_ranges: Any, least_range_m: float) -> Any:
    """Returns a mask of the rows that are returns.

    Args:
        square_ranges: (N,) m^2; values that are not finite and ranges above 100 km are not returns.
        least_range_m: Nearer rows do not count as returns.

    Returns:
        (N,) bool.
    """
    return (square_ranges >= least_range_m**2) & (square_ranges < FARTHEST_M**2)


def take_evenly_on_host(cloud: np.ndarray, some: np.ndarray, count: int) -> np.ndarray:
    """Selects the rows that `draw_evenly` selects.

    Args:
        cloud: (N, 3) m.
        some: The row is a return, (N,) bool.
        count: Most rows to select.

    Returns:
        (count, 3) m; NaN after the last return.
    """
    returns = None if some.all() else np.flatnonzero(some)  # a third of the time, where all are
    total = len(cloud) if returns is None else len(returns)
    share = max(np.float32(total) / np.float32(count), np.float32(1))
    rank = (np.arange(min(total, count), dtype=np.float32) * share).astype(np.int32)
    rows = rank if returns is None else returns.take(rank)
    result = np.empty((count, 3), np.float32)
    np.take(cloud, rows, axis=0, out=result[: len(rows)], mode="clip")  # "raise" copies twice
    result[len(rows) :] = np.nan
    return result


def pad_to_few_sizes(cloud: np.ndarray) -> np.ndarray:
    """Adds rows of NaN to a cloud (N, 3), so that clouds of similar sizes share a compilation.

    There are eight sizes from each power of two to the next.
    """
    unit = 1 << max(0, (len(cloud) - 1).bit_length() - _SIZE_BITS)
    padded = np.empty((-(-len(cloud) // unit) * unit, 3), np.float32)
    padded[: len(cloud)] = cloud
    padded[len(cloud) :] = np.nan
    return padded


@partial(jax.jit, static_argnames="count")
def take_evenly_on_device(cloud: jax.Array, least_range_m: Any, count: int) -> jax.Array:
    """Selects the rows that `draw_returns` selects, as `take_evenly_on_host` returns them.

    Args:
        cloud: (N, 3) m, N at least `count`.
        least_range_m: Nearer rows do not count as returns.
        count: Most rows to select.

    Returns:
        (count, 3) m; NaN after the last return.
    """
    points, some = draw_returns(cloud, least_range_m, count)
    return jnp.where(some[:, None], points, jnp.nan)


def even_steps(total: jax.Array, count: int) -> jax.Array:
    """Returns `count` numbers below `total` at even steps, or 0 to `count` - 1 if it is smaller."""
    steps = jnp.arange(count, dtype=jnp.float32)
    return jnp.where(total > count, jnp.floor(steps * (total / count)), steps)


def draw_informative(
    jacobian: jax.Array, weight: jax.Array, information: jax.Array, count: int
) -> jax.Array:
    """Selects the rows that determine a pose best, so that few determine its weakest direction.

    A row's leverage is its share of the information in each direction, summed over the directions.
    Far walls, edges and what stands across a corridor have much of it. (The idea of geometrically
    stable sampling by Gelfand et al., 3DIM 2003.)

    Args:
        jacobian: Derivative of each row's distance by the pose, (N, 6).
        weight: (N,), 0 for rows that are not to be used.
        information: Symmetric and positive definite, (6, 6), at least the weighted sum of the outer
            products.
        count: Rows to select.

    Returns:
        (count,) int32, ascending; rows of much leverage come more than once.
    """
    leverage = weight * jnp.sum(jacobian * solve_positive(information, jacobian), axis=-1)
    possible = (weight > 0).astype(jnp.float32)

    def share(values: jax.Array) -> jax.Array:
        return values / jnp.maximum(jnp.sum(values), 1e-30)

    chance = _EVEN_SHARE * share(possible) + (1 - _EVEN_SHARE) * share(leverage)
    below = running_sum(chance)
    steps = (jnp.arange(count, dtype=jnp.float32) + 0.5) / count * below[-1]
    return jnp.minimum(count_below(below, steps), chance.shape[0] - 1)
