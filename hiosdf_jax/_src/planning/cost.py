"""What a trajectory pays for being close to surfaces."""

from __future__ import annotations

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def collision_cost(clearance: Any, margin_m: Any) -> jax.Array:
    """The obstacle cost of CHOMP (Zucker et al., IJRR 2013): smooth, zero beyond a margin.

    With the clearance d and the margin e: e / 2 - d where d < 0, (e - d)^2 / (2 e) where
    0 <= d <= e, and 0 beyond. Value and slope are continuous; the slope is -1 in collision.

    Args:
        clearance: (...) m, as from `sphere_clearance`.
        margin_m: m, > 0; any shape that broadcasts with the clearance.

    Returns:
        (...) m. Differentiable.

    Raises:
        ValueError: The margin is not positive (outside jit).
    """
    if not isinstance(margin_m, jax.core.Tracer):
        values = np.asarray(margin_m, float)
        if not ((values > 0) & np.isfinite(values)).all():
            raise ValueError(f"margin_m is {margin_m}, expected > 0 and finite")
    clearance, margin = jnp.asarray(clearance, jnp.float32), jnp.asarray(margin_m, jnp.float32)
    # Clipped before it is squared: an infinite clearance must not make the gradient NaN.
    shortfall = jnp.clip(margin - clearance, 0, margin)
    return shortfall**2 / (2 * margin) + jnp.maximum(-clearance, 0)
