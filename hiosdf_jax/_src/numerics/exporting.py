"""Pytrees that `jax.export` can write to bytes, by names that do not depend on this code."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import jax.export

_PREFIX = "hiosdf_jax"


def exportable(**meta: Callable[[Any], Any]) -> Callable[[type], Any]:
    """Makes a class decorator that registers a pytree with `jax.export`.

    Args:
        **meta: For each static field of the dataclass, what makes its value from JSON; a value that
            is a dataclass is written as its fields. A NamedTuple has none.

    Returns:
        The decorator.
    """

    def register(cls: type) -> type:
        name = f"{_PREFIX}.{cls.__name__}"
        if not dataclasses.is_dataclass(cls):
            return jax.export.register_namedtuple_serialization(cls, serialized_name=name)
        leaves = [field.name for field in dataclasses.fields(cls) if field.name not in meta]

        def write(values: Any) -> bytes:
            return json.dumps(list(values), default=dataclasses.asdict).encode()

        def read(data: bytes | bytearray) -> tuple:
            values = zip(meta.values(), json.loads(bytes(data)), strict=True)
            return tuple(make(value) for make, value in values)

        def build(aux_data: Any, children: Any) -> Any:
            return cls(**dict(zip([*meta, *leaves], [*aux_data, *children], strict=True)))

        return jax.export.register_pytree_node_serialization(
            cls,
            serialized_name=name,
            serialize_auxdata=write,
            deserialize_auxdata=read,
            from_children=build,
        )

    return register


def export_optimizer(*states: type) -> None:
    """Registers the NamedTuples of optax's optimizers, unless the user has done so."""
    for state in states:
        try:
            name = f"optax.{state.__name__}"
            jax.export.register_namedtuple_serialization(state, serialized_name=name)
        except ValueError:
            continue
