"""Checks that arguments are single maps or fields, and not donated."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.numerics.intake import is_traced
from hiosdf_jax._src.state.pytrees import Baked, Field, MapState, field_of

_ONE_OF_THEM = "for one of them use jax.tree.map(lambda x: x[i], maps)"


def check_map(
    state: Any, stacked: bool = False, name: str = "state", batched: str | None = None
) -> None:
    """Checks that an argument is a map.

    Args:
        state: The argument.
        stacked: Whether it may be a stack of maps.
        name: Name of the argument in error messages.
        batched: The call that does the same for a stack, for error messages.

    Raises:
        ValueError: It is not a map, is a stack of maps, or was donated.
    """
    if not isinstance(state, MapState):
        raise ValueError(f"{name} is {type(state).__name__}, expected a MapState from hio.init")
    if stacked:
        _check_kept(name, state)
    else:
        check_single(name, state, batched)


def check_single(name: str, field: MapState | Field | Baked, batched: str | None = None) -> None:
    """Raises a ValueError if an argument is a stack of maps, or arrays that do not match."""
    _check_kept(name, field)
    if isinstance(field, Baked):
        shapes = [np.shape(each) for each in (field.sdf, field.frontier, field.lower)]
        if len(set(shapes)) > 1:
            raise ValueError(
                f"{name} has sdf, frontier and lower of shapes {', '.join(map(str, shapes))}, "
                "expected equal ones"
            )
    voxels = _voxels(field)
    shape = np.shape(voxels)
    if len(shape) != 3:
        advice = f"for {shape[0]} maps at once use {batched}" if batched else _ONE_OF_THEM
        raise ValueError(f"{name} has voxels of shape {shape}, expected those of one map: {advice}")


def _check_kept(name: str, field: MapState | Field | Baked) -> None:
    voxels = _voxels(field)
    if isinstance(voxels, jax.Array) and not is_traced(voxels) and voxels.is_deleted():
        raise ValueError(f"{name} was donated to an update, expected the map that it returned")


def _voxels(field: MapState | Field | Baked) -> jax.Array:
    """Selects the distances at the voxels or samples."""
    if isinstance(field, Baked):
        return field.sdf
    return (field.grid if isinstance(field, MapState) else field.surface).derived.sdf


def as_live_field(field: MapState | Field, batched: str | None = None) -> Field:
    """Selects what queries read of a map or of a snapshot, without a copy.

    Args:
        field: A map or a snapshot of one.
        batched: As for `check_map`.

    Returns:
        The field.

    Raises:
        ValueError: The argument is something else, such as a baked field, or a stack of maps
            outside `jax.vmap`.
    """
    if not isinstance(field, MapState | Field):
        raise ValueError(f"field is {type(field).__name__}, expected a MapState or a Field")
    check_single("field", field, batched)
    return field_of(field) if isinstance(field, MapState) else field
