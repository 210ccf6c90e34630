"""Arguments as arrays on the device."""

from __future__ import annotations

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.posed_cloud import as_floats


def on_device(name: str, values: Any) -> jax.Array:
    """Converts an argument to float32, by a transfer that `jax.transfer_guard` counts as explicit.

    Args:
        name: What messages call the argument.
        values: Real numbers: a JAX array, traced or not, or what numpy makes an array of.

    Returns:
        The array.

    Raises:
        ValueError: The values are no real numbers.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values)):
        values = jnp.asarray(values)
    if not isinstance(values, jax.Array):
        return jax.device_put(as_floats(name, values))
    if not jnp.issubdtype(values.dtype, jnp.floating) and not jnp.issubdtype(
        values.dtype, jnp.integer
    ):
        raise ValueError(f"{name} has dtype {values.dtype}, expected real numbers")
    return values.astype(jnp.float32)


def scalar(value: Any, dtype: Any = np.float32) -> jax.Array:
    """Makes a number an array () on the device, by an explicit transfer."""
    return jax.device_put(np.asarray(value, dtype))
