"""The queries of one field as functions of points alone, for scoring and drawing."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from hiosdf_jax._src.field import queries
from hiosdf_jax._src.state.pytrees import Field


@dataclasses.dataclass(frozen=True)
class CompiledQueries:
    """The queries of one field, each compiled without the answers that it does not return.

    Fields of one configuration share the compilations.

    Attributes:
        field: The field.
    """

    field: Field

    def sdf(self, points_world: Any) -> jax.Array:
        """Signed distances (...) m at points (..., 3) m."""
        return queries.sdf(self.field, points_world)

    def sdf_and_grad(self, points_world: Any) -> tuple[jax.Array, jax.Array]:
        """Signed distances (...) m and gradients (..., 3) at points (..., 3) m."""
        return queries.sdf_and_grad(self.field, points_world)

    def lower(self, points_world: Any) -> jax.Array:
        """Lower bounds of the distance, (...) m, at points (..., 3) m."""
        return _lower(self.field, points_world)

    def observed(self, points_world: Any) -> jax.Array:
        """A mask, (...) bool, of the points (..., 3) m that are observed."""
        return _observed(self.field, points_world)


# The field is an argument, so that each compiles once for all fields of one configuration.
_lower = jax.jit(lambda field, points_world: queries.query(field, points_world).lower)
_observed = jax.jit(lambda field, points_world: queries.query(field, points_world).observed)
