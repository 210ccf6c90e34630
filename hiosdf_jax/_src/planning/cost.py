"""Cost of being close to surfaces."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.intake import is_traced
from hiosdf_jax._src.numerics.modes import plain

_LEAST_M, _MOST_M = 1e-9, 1e9  # margins whose square is a float32


def collision_cost(clearance: Any, margin_m: Any) -> jax.Array:
    """Computes the obstacle cost of CHOMP (Zucker et al., IJRR 2013), zero beyond a margin.

    For clearance d and margin e the cost is e / 2 - d where d < 0, (e - d)^2 / (2 e) where
    0 <= d <= e, and 0 beyond. Value and slope are continuous; the slope is -1 in collision.

    Example:
        def cost(field, centers_world):
            clearance = planning.sphere_clearance(field, centers_world, radii=0.1)
            return planning.collision_cost(clearance, margin_m=0.2).sum()

        gradient = jax.grad(cost, argnums=1)(field, jnp.zeros((5, 3)))

    Args:
        clearance: (...) m, see `sphere_clearance`.
        margin_m: m, > 0; any shape that broadcasts with the clearance.

    Returns:
        (...) m. Differentiable.

    Raises:
        ValueError: A shape is wrong, or (outside jit) the margin is not positive and finite.
    """
    clearance, margin = on_device("clearance", clearance), on_device("margin_m", margin_m)
    try:
        np.broadcast_shapes(clearance.shape, margin.shape)
    except ValueError:
        raise ValueError(
            f"margin_m has shape {margin.shape}, expected one that broadcasts with that of "
            f"clearance, {clearance.shape}"
        ) from None
    if not is_traced(margin):
        values = np.asarray(jax.device_get(margin))
        if not ((values >= _LEAST_M) & (values <= _MOST_M)).all():
            raise ValueError(f"margin_m is {margin_m}, expected > 0 and finite: 1e-9 to 1e9 m")
    return _cost(clearance, margin)


@jax.jit
@plain
def _cost(clearance: jax.Array, margin: jax.Array) -> jax.Array:
    # Inside jit an invalid margin counts as the widest: every collision must cost something.
    margin = jnp.where((margin >= _LEAST_M) & (margin <= _MOST_M), margin, _MOST_M)
    # Clipped before squaring: an infinite clearance must not make the gradient NaN.
    shortfall = jnp.clip(margin - clearance, 0, margin)
    return shortfall**2 / (2 * margin) + jnp.maximum(-clearance, 0)
