"""The variants of a map that are compared: the grid alone, the network alone, and both blended."""

from __future__ import annotations

from collections.abc import Callable

import jax

import hiosdf_jax as hio
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.grid import lookup
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.state.pytrees import Field


def _grid(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    return value_and_gradient(
        lambda points: lookup.grid_sdf(field.config, field.surface, points), points_world
    )


def _network(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    return value_and_gradient(lambda points: blend.network_sdf(field, points), points_world)


# {name: function of a field and points (..., 3) m that returns distances (...) m and gradients}.
# The field is an argument, so that each compiles once for all maps of one configuration.
VARIANTS: dict[str, Callable[..., tuple[jax.Array, jax.Array]]] = {
    "grid": jax.jit(_grid),
    "network": jax.jit(_network),
    "blended": hio.sdf_and_grad,  # compiled already
}
