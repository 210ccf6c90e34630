"""How far a refined pose may be off.

Returns are not independent: those on one piece of surface share the error of the map there. The
returns of one cell of space therefore count as one observation. How much the sums over cells vary
is measured, not assumed (the cluster-robust estimator of Liang and Zeger, Biometrika 1986). For the
covariance the cells are large, and the pose is solved without each of them in turn (the jackknife
estimator of Bell and McCaffrey, Survey Methodology 2002).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.mapping.registration.comparing import Residuals, Rows, information_of, units
from hiosdf_jax._src.mapping.registration.equations import (
    UNKNOWN_M,
    Anchor,
    Directions,
    in_basis,
    invert,
    sizes,
    sum_in_cells,
)
from hiosdf_jax._src.numerics.small_matrices import solve_positive

_SPREAD_CELL_M = 0.5

# Size of the cells that are left out in turn: a share of the typical range, and its limits, m.
# Errors of a map reach about this far. For 200 poses in the simulated apartment the mean normalized
# square is 5.6, and for 99 in a house 7.9; 6 is right. With cells of at most 1 m, 0.4 of the
# range, it is 5.0 and 8.7, and with 0.27 of the range 5.8 and 8.8. Cells are spread to this many
# sums, or fewer if the rows are few. Those that share one are left out at once.
_LEFT_OUT_SHARE = 1 / 3
_LEFT_OUT_M = (0.2, 1.5)
_LEFT_OUT_SUMS = 1024
_LEAST_SUMS = 512
_LEAST_LEFT = 1e-3  # share of a direction's information that always stays


def unknown_covariance() -> jax.Array:
    """Returns the covariance (6, 6) of a pose of which nothing is known."""
    return UNKNOWN_M**2 * jnp.eye(6, dtype=jnp.float32)


def spread_of_slope(residuals: Residuals) -> jax.Array:
    """Measures the covariance of the slope, (6, 6) 1/m^2, from its parts in cells of space."""
    weighted = (residuals.weight * residuals.distance)[:, None] * residuals.jacobian
    values = jnp.concatenate([weighted, residuals.weight[:, None]], axis=-1)
    total = sum_in_cells(values, residuals.points_world, _SPREAD_CELL_M)
    part, count = total[:, :6], jnp.sum(total[:, 6] > 0)
    # Six numbers were fitted to the sums.
    share = jnp.float32(count) / jnp.maximum(count - 6, 1).astype(jnp.float32)
    return share * jnp.matmul(part.T, part, precision="highest")


def inflation_of(residuals: Residuals, directions: Directions) -> jax.Array:
    """Computes how many returns are worth one independent return, at least 1."""
    spread = jnp.diag(in_basis(spread_of_slope(residuals), directions))
    information = jnp.diag(in_basis(information_of(residuals), directions))
    ratio = spread / jnp.maximum(information, 1e-30)
    return jnp.maximum(jnp.sum(ratio) / jnp.maximum(jnp.sum(~directions.free), 1), 1)


def covariance_of(
    residuals: Residuals, directions: Directions, anchor: Anchor, rows: Rows
) -> jax.Array:
    """Computes the covariance of a refined pose.

    Args:
        residuals: The returns at the pose.
        directions: Principal directions, some of them free.
        anchor: What holds free directions.
        rows: The returns.

    Returns:
        (6, 6) m and rad. A free direction without a prior has a standard deviation of 100 m.
    """
    free = jnp.diag(directions.free.astype(jnp.float32))
    independent = invert(in_basis(information_of(residuals), directions) + free) - free
    # At least that of independent returns: a few cells may agree by chance.
    own = _jackknife(residuals, directions, rows) + independent + UNKNOWN_M**2 * free
    if anchor.information is not None:
        prior = directions.basis.T @ anchor.information @ directions.basis
        own = invert(invert(own) + prior)
    size = directions.basis / units(rows)[:, None]
    return size @ own @ size.T


def _jackknife(residuals: Residuals, directions: Directions, rows: Rows) -> jax.Array:
    """Sums the squares of the motions that leaving out each cell in turn would cause, (6, 6)."""
    cell_m = jnp.clip(_LEFT_OUT_SHARE * rows.length, *_LEFT_OUT_M)
    jacobian = jnp.matmul(residuals.jacobian, directions.basis, precision="highest")
    jacobian = jnp.where(directions.free, 0, jacobian)
    weighted = residuals.weight[:, None] * jacobian
    squares = (weighted[:, :, None] * jacobian[:, None, :]).reshape(-1, 36)
    parts = [weighted * residuals.distance[:, None], squares, residuals.weight[:, None]]
    cells = min(_LEFT_OUT_SUMS, max(_LEAST_SUMS, 2 * len(residuals.weight)))
    sums = sum_in_cells(jnp.concatenate(parts, axis=-1), residuals.points_world, cell_m, cells)
    slope, information = sums[:, :6], sums[:, 6:42].reshape(-1, 6, 6)
    whole = jnp.sum(information, axis=0)
    size = sizes(whole)
    rest = size[:, None] * (whole - information) * size + jnp.diag(_LEAST_LEFT + directions.free)
    motion = size * solve_positive(rest, size * slope)
    occupied = sums[:, 42] > 0
    count = jnp.maximum(jnp.sum(occupied), 1).astype(jnp.float32)
    share = (count - 1) / count
    # With a prior the returns alone have a slope, which is not a spread.
    motion = jnp.where(occupied[:, None], motion - jnp.sum(motion, axis=0) / count, 0)
    return share * jnp.matmul(motion.T, motion, precision="highest")
