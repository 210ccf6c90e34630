"""The weighted least-squares problem of a pose, linearized: directions, fits, steps.

Rotations are measured in meters, as the distance by which a return at the cloud's typical range
moves. So all six components of a motion have one unit, and directions can be compared.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.registration.comparing import (
    LOWER,
    Residuals,
    Rows,
    Sums,
    compare,
    loss_of_distance,
    units,
)
from hiosdf_jax._src.mapping.registration.motion import motion_between, move
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.numerics.point_kernel import by_points
from hiosdf_jax._src.numerics.small_matrices import (
    eigenvectors,
    inverse,
    product,
    solve_entries,
    solve_positive,
)
from hiosdf_jax._src.state.pytrees import Baked, Field

# A direction is free if the returns fit about as well where they are moved this far along it, m: if
# their mean loss, which is at most 1, grows by less than this. Its slope alone does not tell: noise
# turns the normals of patches. In maps of corridors it grows by at most 0.0035 along them, and in a
# furnished house by at least 0.0069. A baked field does not know how noisy it is.
_TRIED_M = 0.2
_LEAST_GROWTH = 0.004
_LEAST_GROWTH_BAKED = 0.01

# This many of the least determined directions are tried: a plane leaves three free, a line four,
# and a point five. The first three are free if the returns fit as well on one of the two sides. The
# others must fit on both: in unseen space, for instance behind a wall, nothing contradicts.
_TRIED_DIRECTIONS = 5
_FREE_BY_ONE_SIDE = 3

# With a smaller share of the information of the best determined direction, a direction is free: it
# is a rounding error.
_LEAST_INFORMATION_SHARE = 1e-6

LEAST_COMPARABLE = 0.1
"""Share of the returns that must lie where the map has observed."""

# What a return that the map cannot judge has more than the mean loss of the worse of two
# poses. Without it, clouds with 15 % of outliers are moved to where the map ends.
_UNKNOWN_MORE = 0.1

UNKNOWN_M = 100.0
"""Standard deviation of what is not known of a pose, m and rad, as in a free direction."""

# Cells of space, over which normals are averaged, m, and sums to which cells are spread.
_NORMALS_CELL_M = 0.3
_CELLS = 4096


class Anchor(NamedTuple):
    """What holds the directions that the returns do not determine.

    Attributes:
        pose: (4, 4), the mean of the prior, or the initial pose.
        information: Inverse covariance of the prior, (6, 6), in meters; None without a prior.
    """

    pose: jax.Array
    information: jax.Array | None


class Directions(NamedTuple):
    """Principal directions of an information matrix.

    Attributes:
        basis: Unit vectors as columns, (6, 6).
        free: The returns do not determine the direction, (6,) bool.
    """

    basis: jax.Array
    free: jax.Array


def _whole(lower: jax.Array) -> jax.Array:
    """Makes a symmetric matrix (6, 6) of its lower half (21,)."""
    place = {pair: number for number, pair in enumerate(LOWER)}
    return lower[np.array([[place[max(i, j), min(i, j)] for j in range(6)] for i in range(6)])]


def sum_in_cells(
    values: jax.Array, points_world: jax.Array, cell_m: jax.Array | float, cells: int = _CELLS
) -> jax.Array:
    """Sums values (N, K) over the points (N, 3), m, of each cell of space; (cells, K)."""
    cell = jnp.floor(points_world / cell_m).astype(jnp.int32).astype(jnp.uint32)
    # Large odd numbers spread the cells over the sums. Few share one by chance.
    row = cell[:, 0] * 73856093 ^ cell[:, 1] * 19349663 ^ cell[:, 2] * 83492791
    return jax.ops.segment_sum(values, (row % cells).astype(jnp.int32), cells)


def find_directions(
    field: Field | Baked, rows: Rows, pose: jax.Array, here: Residuals
) -> Directions:
    """Finds the principal directions of the returns' information, and which are free.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4), near the solution.
        here: The returns at this pose, compared with a scale of 0.

    Returns:
        The directions, the least determined first.
    """
    # Means over cells of space: they average the noise of normals.
    counts = (here.weight * here.sigma**2)[:, None]
    values = jnp.concatenate([counts, counts * here.jacobian], axis=-1)
    total = sum_in_cells(values, here.points_world, _NORMALS_CELL_M)
    count = total[:, :1]
    mean = total[:, 1:] / jnp.maximum(count, 1e-9)
    information = jnp.matmul(mean.T, count * mean, precision="highest")
    basis = eigenvectors(information)
    determined = jnp.sum(basis * product(information, basis), axis=0)

    def growth(motion: jax.Array) -> jax.Array:
        there = compare(field, rows, move(pose, motion), 0.0)
        # Returns that move to where the map ends cannot be compared.
        both = here.comparable & there.comparable
        more = jnp.where(both, loss_of_distance(there) - loss_of_distance(here), 0)
        return jnp.sum(more) / jnp.maximum(jnp.sum(both), 1)

    forward = _TRIED_M * basis.T[:_TRIED_DIRECTIONS] / units(rows)
    both_ways = jnp.concatenate([forward, -forward])
    # All at once would need much memory where XLA makes arrays of all that leads to the losses.
    at_once = devices.has_kernels() and isinstance(field, Field)
    grown = jax.vmap(growth)(both_ways) if at_once else jax.lax.map(growth, both_ways)
    grown = grown.reshape(2, -1)
    least = _LEAST_GROWTH_BAKED if isinstance(field, Baked) else _LEAST_GROWTH
    number = np.arange(_TRIED_DIRECTIONS)
    by_one = number < _FREE_BY_ONE_SIDE
    free = ~(jnp.where(by_one, jnp.min(grown, axis=0), jnp.max(grown, axis=0)) >= least)
    free = jnp.concatenate([free, jnp.zeros(6 - _TRIED_DIRECTIONS, bool)])
    free |= determined < _LEAST_INFORMATION_SHARE * jnp.max(determined)
    return Directions(basis, free | ~jnp.any(here.comparable))


class Fit(NamedTuple):
    """How badly returns fit.

    Attributes:
        loss: Mean loss of the returns that the map can judge, () from 0 to 1; inf if
            they are too few. A return in space that was seen empty has loss 1.
        known: Their share of all returns, ().
    """

    loss: jax.Array
    known: jax.Array


def fit_of(sums: Sums, some: jax.Array) -> Fit:
    """Computes how badly returns (N,) fit."""
    count = jnp.sum(some)
    enough = sums.known >= jnp.maximum(LEAST_COMPARABLE * count, 1)
    mean = jnp.where(enough, sums.loss / jnp.maximum(sums.known, 1), jnp.inf)
    return Fit(mean, sums.known / jnp.maximum(count, 1).astype(jnp.float32))


def fits_better(one: Fit, other: Fit, least: jax.Array | float = 0.0) -> jax.Array:
    """Returns whether a cloud fits better in one pose than in another, () bool.

    The mean loss must differ by more than `least`.

    A return that the map cannot judge counts more than a known one in the worse pose. So no
    pose is better because fewer returns can be compared there.
    """
    unknown = jnp.maximum(one.loss, other.loss) + _UNKNOWN_MORE
    first, second = (fit.known * fit.loss + (1 - fit.known) * unknown for fit in (one, other))
    return jnp.where(jnp.isfinite(unknown), first < second - least, one.loss < other.loss)


def in_basis(matrix: jax.Array, directions: Directions) -> jax.Array:
    """Expresses a matrix (6, 6) in the basis of the directions, with zeros for free ones."""
    inside = product(directions.basis.T, product(matrix, directions.basis))
    bound = ~directions.free
    return jnp.where(bound[:, None] & bound, inside, 0)


def balance(
    directions: Directions | None, slope: jax.Array, anchor: Anchor, rows: Rows, pose: jax.Array
) -> jax.Array:
    """Computes what is zero at the solution: the slopes of returns and anchor.

    Returns do not constrain free directions. There the prior decides, or the initial pose.

    Args:
        directions: The principal directions of the returns' information. None stands for the axes,
            none of them free.
        slope: Slope of the returns' cost by the motion, (6,).
        anchor: What holds free directions.
        rows: The returns.
        pose: (4, 4).

    Returns:
        (6,), one component per direction.
    """
    own = slope
    if directions is not None:
        own = jnp.where(directions.free, 0, product(directions.basis.T, slope))
    pull = _pull(directions, anchor)
    if pull is None:
        return own
    return own + product(pull, units(rows) * motion_between(anchor.pose, pose))


def stiffness(information: jax.Array, directions: Directions | None, anchor: Anchor) -> jax.Array:
    """Computes the information of returns and anchor, (6, 6), in the directions' basis."""
    own = information if directions is None else in_basis(information, directions)
    pull = _pull(directions, anchor)
    if pull is None:
        return own
    return own + (pull if directions is None else product(pull, directions.basis))


def find_step(
    sums: Sums,
    directions: Directions | None,
    anchor: Anchor,
    rows: Rows,
    pose: jax.Array,
    inflation: jax.Array | float = 1.0,
    damping: float = 0.0,
) -> jax.Array:
    """Computes the Gauss-Newton step.

    Args:
        sums: The returns at the pose, summed.
        directions: As for `balance`.
        anchor: As for `balance`.
        rows: As for `balance`.
        pose: As for `balance`.
        inflation: How many returns are worth one independent return.
        damping: Added to the diagonal of the information, as a share of its mean.

    Returns:
        The motion, (6,) m and rad.
    """
    if directions is None and anchor.information is None:
        # Inflation cancels where nothing else holds the pose.
        length = rows.length[None]
        return by_points(_free_step_at, damping, (), sums.values[None], numbers=length, least=1)[0]
    information = _whole(sums.information) / inflation
    information += damping * jnp.trace(information) / 6 * jnp.eye(6, dtype=jnp.float32)
    matrix = stiffness(information, directions, anchor)
    wanted = balance(directions, sums.slope / inflation, anchor, rows, pose)
    step = solve_positive(matrix, wanted)
    if directions is not None:
        step = product(directions.basis, step)
    return -step / units(rows)


def _free_step_at(damping: float, tables: Any, length: Any, sums: Any) -> tuple[jax.Array, ...]:
    """Computes a step along the axes that nothing but the returns holds, (...) each."""
    lower = dict(zip(LOWER, sums[:21], strict=True))
    more = damping / 6 * reduce(jnp.add, [lower[i, i] for i in range(6)])
    matrix = [[lower[i, j] + (more if i == j else 0) for j in range(i + 1)] for i in range(6)]
    step = solve_entries(matrix, sums[21:27])
    return (*(-part for part in step[:3]), *(-part / length[0] for part in step[3:]))


def invert(matrix: jax.Array) -> jax.Array:
    """Inverts a positive definite matrix whose rows differ by many orders of magnitude."""
    size = sizes(matrix)
    return size[:, None] * inverse(size[:, None] * matrix * size) * size


def sizes(matrix: jax.Array) -> jax.Array:
    """Returns factors (6,) that scale rows and columns of a matrix to a unit diagonal."""
    return jax.lax.rsqrt(jnp.maximum(jnp.diag(matrix), 1e-12))


def _pull(directions: Directions | None, anchor: Anchor) -> jax.Array | None:
    """The anchor's information, from motions to the directions' basis, (6, 6), or None."""
    if directions is None:
        return anchor.information
    if anchor.information is None:
        return jnp.where(directions.free, UNKNOWN_M**-2, 0)[:, None] * directions.basis.T
    return product(directions.basis.T, anchor.information)
