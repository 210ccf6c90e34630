"""How far a refined pose may be off.

Returns are not independent: those on one piece of surface share the error of the map there. The
returns of one cell of space therefore count as one observation. The spread of the sums over cells
is measured, not assumed (the cluster-robust estimator of Liang and Zeger, Biometrika 1986).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hiosdf_jax._src.mapping.registration.equations import (
    Anchor,
    Directions,
    Residuals,
    Rows,
    information_of,
    invert,
    sum_in_cells,
    turn,
    units,
)

_CELL_M = 0.5

_FREE_M = 100.0  # standard deviation of a free direction without a prior


def spread_of_slope(residuals: Residuals) -> jax.Array:
    """Measures the covariance of the slope, (6, 6) 1/m^2, from its parts in cells of space."""
    weighted = (residuals.weight * residuals.distance)[:, None] * residuals.jacobian
    values = jnp.concatenate([weighted, residuals.weight[:, None]], axis=-1)
    total = sum_in_cells(values, residuals.points_world, _CELL_M)
    part, count = total[:, :6], jnp.sum(total[:, 6] > 0)
    # Six numbers were fitted to the sums.
    share = jnp.float32(count) / jnp.maximum(count - 6, 1).astype(jnp.float32)
    return share * jnp.matmul(part.T, part, precision="highest")


def inflation_of(residuals: Residuals, directions: Directions) -> jax.Array:
    """Computes how many returns tell as much as one independent one would, at least 1."""
    spread = jnp.diag(turn(spread_of_slope(residuals), directions))
    information = jnp.diag(turn(information_of(residuals), directions))
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
    inverse = invert(turn(information_of(residuals), directions) + free) - free
    # At least that of independent returns: a few cells may agree by chance.
    own = inverse @ turn(spread_of_slope(residuals), directions) @ inverse + inverse
    own += _FREE_M**2 * free
    if anchor.information is not None:
        prior = directions.basis.T @ anchor.information @ directions.basis
        own = invert(invert(own) + prior)
    size = directions.basis / units(rows)[:, None]
    return size @ own @ size.T
