"""Arguments as arrays on the device."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.numerics.intake import as_array


def on_device(name: str, values: Any) -> jax.Array:
    """Converts an argument to float32, by a transfer that `jax.transfer_guard` counts as explicit.

    Args:
        name: Name of the argument in error messages.
        values: As for `as_array`.

    Returns:
        The array.

    Raises:
        ValueError: The values are not real numbers.
    """
    array = as_array(name, values)
    return array if isinstance(array, jax.Array) else jax.device_put(array)


def scalar(value: Any) -> jax.Array:
    """Makes a number a float32 array () on the device, by an explicit transfer."""
    return jax.device_put(np.float32(value))
