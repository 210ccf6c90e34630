"""Short texts of pytrees: the types and shapes of arrays instead of their numbers."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.intake import is_traced

_WIDTH = 88  # with the name that stands before it, at most about 100
_INDENT = 2
_LONGEST_LEAF = 100


class Described(flax.struct.PyTreeNode):
    """A pytree whose `repr` is short: with its numbers, that of a map would have 140 KB."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(repr=False, **options)

    def __repr__(self) -> str:
        """Returns the names of the leaves with their types and shapes, and values of scalars."""
        return describe(self)


def describe(value: Any, indent: int = 0) -> str:
    """Writes a pytree as text that stays short however large its arrays are.

    Args:
        value: Any nest of dataclasses, named tuples, lists, tuples and dictionaries. The leaves may
            be arrays, also traced, stacked or donated ones, or anything else.
        indent: Columns before the lines after the first one.

    Returns:
        The text. It has the type and shape of arrays, the value of scalars where it is known, and,
        for dataclasses that are not pytrees, such as `Config`, the fields that are not the default.
    """
    parts = _parts(value)
    if parts is None:
        return _leaf(value)
    start, fields, end = parts
    texts = [label + describe(each, indent + _INDENT) for label, each in fields]
    line = start + ", ".join(texts) + end
    if "\n" not in line and indent + len(line) <= _WIDTH:
        return line
    margin = "\n" + " " * indent
    inner = margin + " " * _INDENT
    return start + inner + ("," + inner).join(texts) + margin + end


def _parts(value: Any) -> tuple[str, list[tuple[str, Any]], str] | None:
    """Takes a node apart into what stands before, in and behind it; None for a leaf."""
    if type(value) is list:
        return "[", [("", each) for each in value], "]"
    if type(value) is tuple:
        return "(", [("", each) for each in value], ",)" if len(value) == 1 else ")"
    if isinstance(value, dict):
        return "{", [(f"{key!r}: ", each) for key, each in value.items()], "}"
    start = f"{type(value).__name__}("
    names = getattr(value, "_fields", None)
    if isinstance(value, tuple) and names is not None:
        return start, [(f"{name}=", each) for name, each in zip(names, value, strict=True)], ")"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return start, _fields(value), ")"
    return None


def _fields(value: Any) -> list[tuple[str, Any]]:
    """Selects all fields of a pytree, and those of a configuration that are not the default."""
    pairs = [(field, getattr(value, field.name)) for field in dataclasses.fields(value)]
    if not isinstance(value, flax.struct.PyTreeNode):
        pairs = [(field, each) for field, each in pairs if each != field.default]
    return [(f"{field.name}=", each) for field, each in pairs]


def _leaf(value: Any) -> str:
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return _array(value)
    text = repr(value)
    return text if len(text) <= _LONGEST_LEAF else f"<{type(value).__name__}>"


def _array(value: Any) -> str:
    """Writes the value of a scalar that is known, and else the type and the shape."""
    kind = f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if isinstance(value, jax.Array):
        if is_traced(value):
            return f"traced {kind}"
        if value.is_deleted():
            return f"donated {kind}"
        if not value.is_fully_addressable:
            return kind
    elif not isinstance(value, np.ndarray | np.generic):  # such as a ShapeDtypeStruct
        return kind
    is_key = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
    return str(jax.device_get(value)) if value.shape == () and not is_key else kind
