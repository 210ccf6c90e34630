"""The one way in for numbers, clouds and poses: float32, or a ValueError that names the argument.

Numbers of any real type and byte order are accepted. Strings, booleans, complex numbers, times and
Python objects, among them whole numbers beyond 64 bits, are not.
"""

from __future__ import annotations

import numbers
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.rigid import FARTHEST_M, TOLERANCE, is_rigid_on_host

_DEEPEST = 16  # an array has three axes or four
_NESTED = list, tuple  # `list | tuple` would be created again for each leaf of a map
_MOST_WHOLE = 2**31 - 1  # a loop counts in int32
_LEAST_VARIANCE = 1e-20  # of a pose, m^2 or rad^2; its square is a number of float32
_ROUNDING = 1e-5  # of the eigenvalues of a correlation matrix (6, 6) in float32
_ASYMMETRY = 2e-3  # of such a matrix inside jit
_MOST_CORRELATION = 1.001
_FIRST_ROWS = 256  # almost always, one of these rows of a cloud is a return


def as_real(name: str, values: Any) -> np.ndarray:
    """Checks that an argument is an array of real numbers.

    Args:
        name: Name of the argument in error messages.
        values: Concrete numbers: an array, or anything that `np.asarray` accepts.

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
    except Exception as error:  # rows of different lengths, or whatever a third-party object raises
        raise ValueError(f"{name} is not an array of numbers: {error}") from error
    _check_type(name, array)
    if not np.ma.isMaskedArray(array):
        return array
    if array.dtype.kind in "iu":  # whole numbers have no NaN
        array = array.astype(np.float64)
    return np.ma.filled(array, np.nan)


def as_floats(name: str, values: Any) -> np.ndarray:
    """Converts an argument to float32. Masked elements become NaN, those too large inf.

    Args:
        name: Name of the argument in error messages.
        values: Concrete numbers: an array, or anything that `np.asarray` accepts.

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
        name: Name of the argument in error messages.
        values: Numbers, as for `as_floats`, or arrays of JAX, also in lists.

    Returns:
        An array of JAX if one came, otherwise as from `as_floats`. Nothing waits for a device.

    Raises:
        ValueError: The values are not real numbers.
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
    except Exception as error:  # unequal shapes, or whatever a third-party object raises
        raise ValueError(f"{name} is not an array of numbers: {error}") from error


def as_number(name: str, value: Any, least: float | None = None, *, above: bool = False) -> float:
    """Checks one finite number.

    Args:
        name: Name of the argument in error messages.
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
        name: Name of the argument in error messages.
        value: The count, not traced.
        least: Its least value.
        most: Its largest value.

    Raises:
        ValueError: It is not a whole number, or is out of range.
    """
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not (whole and int(value) >= least):
        raise ValueError(f"{name} is {value!r}, expected a whole number >= {least}")
    if int(value) > most:
        raise ValueError(f"{name} is {value!r}, expected at most {most}")


def as_key(name: str, key: Any, batched: str | None = None) -> jax.Array:
    """Checks that an argument is one random key.

    Args:
        name: Name of the argument in error messages.
        key: From `jax.random.key`, or an older one from `PRNGKey`; may be traced.
        batched: The call that takes several keys, for error messages.

    Returns:
        The typed key.

    Raises:
        ValueError: It is something else, or several keys.
    """
    expected = "expected one key, such as jax.random.key(0)"
    try:
        array = key if isinstance(key, jax.Array) else jnp.asarray(key)
    except Exception as error:  # whatever a third-party object raises
        raise ValueError(f"{name} is {type(key).__name__}, {expected}") from error
    is_typed = jnp.issubdtype(array.dtype, jax.dtypes.prng_key)
    if is_typed and array.shape == ():
        return array
    if array.dtype == jnp.uint32 and array.shape == (2,):
        return jax.random.wrap_key_data(array)
    if is_typed and batched:
        expected += f"; for {array.shape[0]} of them use {batched}"
    raise ValueError(f"{name} has dtype {array.dtype} and shape {array.shape}, {expected}")


def as_traced(cloud: Any, pose: Any) -> tuple[jax.Array, jax.Array]:
    """Checks types and shapes only, which tracers have as well.

    Args:
        cloud: Expected (N, 3).
        pose: Expected (4, 4).

    Returns:
        Both as arrays of JAX, float32.

    Raises:
        ValueError: A type or a shape is wrong.
    """
    cloud, pose = as_array("cloud", cloud), as_array("pose", pose)
    _check_cloud_shape(cloud)
    _check_pose_shape(pose)
    return jnp.asarray(cloud), jnp.asarray(pose)


def checked_cloud(cloud: Any) -> np.ndarray:
    """Checks a cloud, and returns it as (N, 3) float32; masked elements are NaN.

    Raises:
        ValueError: It is not an array of real numbers, or is misshapen.
    """
    floats = as_floats("cloud", cloud)
    _check_cloud_shape(floats)
    return floats


def cloud_and_returns(cloud: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checks a cloud and finds its returns.

    Args:
        cloud: (N, 3) m; a row with a NaN or inf is not a return.

    Returns:
        The cloud as from `checked_cloud`, and a mask of its returns, (N,) bool, at least one of
        them True.

    Raises:
        ValueError: The cloud is misshapen or has no return.
    """
    floats = checked_cloud(cloud)
    finite = _are_finite(floats)
    if not finite.any():
        raise ValueError(
            f"cloud has no finite row among its {len(finite)}, expected at least one return"
        )
    return floats, finite


def check_has_return(cloud: np.ndarray) -> None:
    """Checks that a cloud (N, 3) float32 has a return, without a look at all of its rows.

    Raises:
        ValueError: No row is finite.
    """
    if not _are_finite(cloud[:_FIRST_ROWS]).any():
        cloud_and_returns(cloud)


def _are_finite(cloud: np.ndarray) -> np.ndarray:
    x, y, z = cloud.T  # one column at a time is many times faster than all(axis=1)
    return np.isfinite(x) & np.isfinite(y) & np.isfinite(z)


def check_vectors(name: str, vectors: Any) -> None:
    """Checks that an array holds vectors, (..., 3); its values may be traced.

    Args:
        name: Name of the argument in error messages.
        vectors: An array.

    Raises:
        ValueError: Its last axis is not of length 3.
    """
    shape = np.shape(vectors)
    if not shape or shape[-1] != 3:
        raise ValueError(f"{name} has shape {shape}, expected (..., 3){_if_transposed(shape)}")


def _if_transposed(shape: tuple[int, ...]) -> str:
    """Returns a question for the end of a message, if an array of vectors has shape (3, N)."""
    return "; is it transposed?" if len(shape) == 2 and shape[0] == 3 else ""


def check_pose(pose: Any, source: str = "") -> np.ndarray:
    """Checks that a pose is a rigid transform.

    Args:
        pose: (4, 4) T_world_sensor.
        source: Where the pose comes from, such as a file and a line. The message starts with it.

    Returns:
        (4, 4) float32, a copy of the pose.

    Raises:
        ValueError: The pose is misshapen, not finite or not rigid.
    """
    prefix = f"{source}: " if source else ""
    matrix = np.array(as_floats(f"{prefix}pose", pose))  # too large for float32: inf, refused below
    _check_pose_shape(matrix, prefix)
    if not np.isfinite(matrix).all():
        raise ValueError(
            f"{prefix}pose has values that are not finite, expected a rigid transform: "
            f"{_printed(matrix)}"
        )
    if not is_rigid_on_host(matrix):
        raise ValueError(f"{prefix}pose {_pose_fault(matrix)}: {_printed(matrix)}")
    return matrix


def check_covariance(name: str, covariance: np.ndarray) -> None:
    """Checks that a matrix is the covariance of the error of a pose.

    Args:
        name: Name of the argument in error messages.
        covariance: (6, 6), m and rad.

    Raises:
        ValueError: The matrix is not finite, symmetric and positive definite. One that is singular
            to float32's rounding passes: a corridor that does not run along an axis has such a one.
    """
    exact = covariance.astype(np.float64)
    expected = "expected a symmetric, positive definite matrix, m and rad"
    if not np.isfinite(exact).all():
        raise ValueError(f"{name} has values that are not finite, {expected}")
    if np.diag(exact).min() < _LEAST_VARIANCE:
        raise ValueError(f"{name} is not positive definite, {expected}")
    # In units of each component's own deviation: those of meters and radians differ.
    size = np.sqrt(np.diag(exact))
    scaled = exact / np.outer(size, size)
    if not np.allclose(scaled, scaled.T, atol=1e-3):
        raise ValueError(f"{name} is not symmetric, {expected}")
    if np.linalg.eigvalsh((scaled + scaled.T) / 2)[0] < -_ROUNDING:
        raise ValueError(f"{name} is not positive definite, {expected}")


def may_be_covariance(matrix: jax.Array) -> jax.Array:
    """Returns whether a matrix (6, 6) may be a covariance, () bool, also inside jit.

    Less strict than `check_covariance`: of the eigenvalues, only pairs of axes are looked at.
    """
    variance = jnp.diag(matrix)
    scale = jnp.sqrt(jnp.maximum(variance, _LEAST_VARIANCE))
    scaled = matrix / scale[:, None] / scale
    symmetric = jnp.abs(scaled - scaled.T) <= _ASYMMETRY
    correlated = jnp.abs(scaled) <= _MOST_CORRELATION
    return jnp.all(variance >= _LEAST_VARIANCE) & jnp.all(symmetric & correlated)


def is_traced(*values: Any) -> bool:
    """Returns whether some values, or members of their lists and tuples, are traced by JAX."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in _leaves(values))


def _leaves(values: Any) -> list[Any]:
    """The members of nested lists and tuples."""
    found, inner = [], [values]
    for _ in range(_DEEPEST):
        found += [value for value in inner if not isinstance(value, _NESTED)]
        inner = [each for value in inner if isinstance(value, _NESTED) for each in value]
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


def _check_cloud_shape(cloud: Any) -> None:
    shape = np.shape(cloud)
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"cloud has shape {shape}, expected (N, 3){_if_transposed(shape)}")


def _check_pose_shape(pose: Any, prefix: str = "") -> None:
    if np.shape(pose) != (4, 4):
        raise ValueError(f"{prefix}pose has shape {np.shape(pose)}, expected (4, 4)")


def _pose_fault(pose: np.ndarray) -> str:
    """Says in words why a finite pose is refused."""
    rotation, position = pose[:3, :3].astype(np.float64), pose[:3, 3].astype(np.float64)
    gram = rotation.T @ rotation
    lengths = np.sqrt(np.diag(gram))
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        hint = "; is it transposed?" if is_rigid_on_host(pose.T) else ""
        return f"is not rigid: its last row is {_printed(pose[3])}, expected [0, 0, 0, 1]{hint}"
    if np.abs(lengths**2 - 1).max() > TOLERANCE:
        length = f"{lengths[0]:.4g}" if np.ptp(lengths) <= TOLERANCE else _printed(lengths)
        return f"is not rigid: its columns have length {length}, expected 1"
    if np.linalg.det(rotation) < 0:
        return "is not rigid: its determinant is -1, expected 1; it mirrors the cloud"
    if np.abs(position).max() > FARTHEST_M:
        kilometers = np.linalg.norm(position) / 1000
        return f"is {kilometers:.4g} km from the origin, expected at most {FARTHEST_M / 1000:g} km"
    return "is not rigid: its columns are not perpendicular, expected a rotation"


def _printed(matrix: np.ndarray) -> str:
    return " ".join(np.array2string(matrix, precision=4, separator=", ").split())  # in one line
