"""The one way in for numbers: they become float32, or a ValueError names the argument.

Numbers of any real type come in, in any byte order. Strings, booleans, complex numbers, times and
Python objects, among them whole numbers beyond 64 bits, do not.
"""

from __future__ import annotations

import numbers
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

_DEEPEST = 16  # an array has three axes or four
_MOST_WHOLE = 2**31 - 1  # a loop counts in int32


def as_real(name: str, values: Any) -> np.ndarray:
    """Checks that an argument is an array of real numbers.

    Args:
        name: What messages call the argument.
        values: Concrete numbers in an array, or what numpy makes one of.

    Returns:
        The numbers in their own type, not copied; masked elements are NaN.

    Raises:
        ValueError: The values are traced, or no real numbers.
    """
    if is_traced(values):
        raise ValueError(f"{name} is traced, expected concrete numbers, as outside jit")
    if any(_is_boolean(leaf) for leaf in _leaves(values)):  # numpy makes 1 of True beside numbers
        raise ValueError(f"{name} has booleans, expected real numbers")
    try:
        array = np.ma.asanyarray(values) if _has_mask(values) else np.asarray(values)
    except Exception as error:  # rows of different lengths, or whatever a foreign object raises
        raise ValueError(f"{name} is no array of numbers: {error}") from error
    _check_type(name, array)
    if not np.ma.isMaskedArray(array):
        return array
    if array.dtype.kind in "iu":  # whole numbers have no NaN
        array = array.astype(np.float64)
    return np.ma.filled(array, np.nan)


def as_floats(name: str, values: Any) -> np.ndarray:
    """Converts an argument to float32. Masked elements become NaN, those too large inf.

    Args:
        name: What messages call the argument.
        values: Concrete numbers in an array, or what numpy makes one of.

    Returns:
        The array; not a copy if it is float32 already.

    Raises:
        ValueError: The values are traced, or no real numbers.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return as_real(name, values).astype(np.float32, copy=False)


def as_array(name: str, values: Any) -> np.ndarray | jax.Array:
    """Converts an argument that may be traced, or lie on a device, to float32.

    Args:
        name: What messages call the argument.
        values: Numbers, as for `as_floats`, or arrays of JAX, also in lists.

    Returns:
        An array of JAX if one came, otherwise as from `as_floats`. Nothing waits for a device.

    Raises:
        ValueError: The values are no real numbers.
    """
    if not any(isinstance(leaf, jax.Array) for leaf in _leaves(values)):
        return as_floats(name, values)
    if isinstance(values, jax.Array) and not is_traced(values) and values.is_deleted():
        raise ValueError(f"{name} was donated or deleted, expected an array")
    try:
        if not isinstance(values, jax.Array):
            for leaf in _leaves(values):
                if not isinstance(leaf, jax.Array):
                    as_real(name, leaf)
        if _has_mask(values):
            raise ValueError("masks and arrays of JAX are mixed")
        array = values if isinstance(values, jax.Array) else jnp.asarray(values)
        _check_type(name, array)
        return array.astype(jnp.float32)
    except Exception as error:  # unequal shapes, or whatever a foreign object raises
        raise ValueError(f"{name} is no array of numbers: {error}") from error


def as_number(name: str, value: Any, least: float | None = None, *, above: bool = False) -> float:
    """Checks one finite number.

    Args:
        name: What messages call the argument.
        value: The number, not traced.
        least: Its least value.
        above: The number must be larger than `least`.

    Returns:
        The number.

    Raises:
        ValueError: It is something else, or less.
    """
    array = as_real(name, value)
    limit = -np.inf if least is None else least
    if array.shape == ():
        number = float(array)
        if np.isfinite(number) and (number > limit if above else number >= limit):
            return number
    bound = "a number" if least is None else f"{'>' if above else '>='} {least:g}"
    raise ValueError(f"{name} is {value!r}, expected {bound} and finite")


def check_whole(name: str, value: Any, least: int, most: int = _MOST_WHOLE) -> None:
    """Checks a count that shapes or loops depend on.

    Args:
        name: What messages call the argument.
        value: The count, not traced.
        least: Its least value.
        most: Its largest value.

    Raises:
        ValueError: It is no whole number, or out of range.
    """
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not (whole and int(value) >= least):
        raise ValueError(f"{name} is {value!r}, expected a whole number >= {least}")
    if int(value) > most:
        raise ValueError(f"{name} is {value!r}, expected at most {most}")


def as_key(name: str, key: Any) -> jax.Array:
    """Checks that an argument is one random key.

    Args:
        name: What messages call the argument.
        key: From `jax.random.key`, or an older one from `PRNGKey`; may be traced.

    Returns:
        The typed key.

    Raises:
        ValueError: It is something else, or several keys.
    """
    try:
        array = key if isinstance(key, jax.Array) else jnp.asarray(key)
    except Exception as error:  # whatever a foreign object raises
        raise ValueError(f"{name} is {type(key).__name__}, expected one jax.random.key") from error
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) and array.shape == ():
        return array
    if array.dtype == jnp.uint32 and array.shape == (2,):
        return jax.random.wrap_key_data(array)
    raise ValueError(
        f"{name} has dtype {array.dtype} and shape {array.shape}, expected one jax.random.key"
    )


def is_traced(*values: Any) -> bool:
    """Returns whether some values, or members of their lists and tuples, are traced by JAX."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in _leaves(values))


def _leaves(values: Any) -> list[Any]:
    """The members of nested lists and tuples."""
    found, inner = [], [values]
    for _ in range(_DEEPEST):
        found += [value for value in inner if not isinstance(value, list | tuple)]
        inner = [each for value in inner if isinstance(value, list | tuple) for each in value]
        if not inner:
            return found
    raise ValueError(f"lists are nested more than {_DEEPEST} deep, expected an array of numbers")


def _is_boolean(value: Any) -> bool:
    if isinstance(value, np.ndarray | jax.Array):
        return bool(jnp.issubdtype(value.dtype, np.bool_))
    return isinstance(value, bool | np.bool_)


def _has_mask(values: Any) -> bool:
    return any(np.ma.isMaskedArray(each) for each in _leaves(values))


def _check_type(name: str, array: Any) -> None:
    dtype = array.dtype
    real = jnp.issubdtype(dtype, np.floating) or jnp.issubdtype(dtype, np.integer)
    if not real or dtype.kind == "m":  # numpy counts spans of time among the integers
        raise ValueError(f"{name} has dtype {dtype}, expected real numbers")
