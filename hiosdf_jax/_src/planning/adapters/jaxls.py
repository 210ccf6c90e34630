"""Costs and hard constraints of `jaxls`, whose Jacobians take one query of the map."""

# Without jaxls, pyright resolves the import to this module itself.
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxls import Cost, Var  # pyright: ignore[reportMissingImports]

from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.numerics.intake import as_number
from hiosdf_jax._src.planning.body import clearance_and_jacobian
from hiosdf_jax._src.state.pytrees import Bound

VariableSpheres = Callable[[Any], tuple[jax.Array, Any]]
"""Value of a variable -> the body's spheres: centers_world (S, 3) m and radii (S,) m."""


def clearance_constraint(
    spheres: VariableSpheres,
    *,
    margin_m: float,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> Callable[[AnyField, Var], Cost]:
    """Makes the hard constraint that every sphere of a body keeps a margin to the map.

    Call the result inside the function that you compile and that takes the map as an argument. Then
    one compilation serves all maps of one configuration, and jaxls does not copy the map for each
    variable.

    Example:
        class Waypoint(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
            pass

        @jaxls.Cost.factory
        def step(values, here, there):
            return values[there] - values[here]

        def body(position):
            return position[None], jnp.array([0.15])

        clear = planning.jaxls.clearance_constraint(body, margin_m=0.05)

        @jax.jit
        def plan(field, guess):
            path = Waypoint(jnp.arange(len(guess)))
            here, there = Waypoint(path.id[:-1]), Waypoint(path.id[1:])
            problem = jaxls.LeastSquaresProblem([step(here, there), clear(field, path)], [path])
            return problem.analyze().solve(jaxls.VarValues.make([path.with_value(guess)]))[Waypoint]

        waypoints_world = plan(field, jnp.linspace(jnp.zeros(3), jnp.ones(3), 8))

    Args:
        spheres: The body at a variable's value, a pure function of JAX arrays. The radii do not
            depend on the value.
        margin_m: Clearance to keep, m, >= 0.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (field, variable) -> the constraint clearance - margin >= 0, (S,) m. The variable may be of
        any kind, on a manifold too. Its id is one number, or (T,) numbers for T constraints.

    Raises:
        ValueError: The margin is negative or not finite.
    """
    margin_m = as_number("margin_m", margin_m, 0)

    def kept(clearance: jax.Array, jacobian: jax.Array) -> tuple[jax.Array, jax.Array]:
        return clearance - margin_m, jacobian

    return _by_map(spheres, kept, "constraint_geq_zero", "clearance_constraint", unknown, bound)


def clearance_cost(
    spheres: VariableSpheres,
    *,
    margin_m: float,
    weight: float = 1.0,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> Callable[[AnyField, Var], Cost]:
    """Makes a cost of spheres that are closer to the map than a margin.

    The residual of a sphere is weight * max(margin - clearance, 0), which jaxls squares.

    Example:
        def body(position):
            return position[None], jnp.array([0.15])

        near = planning.jaxls.clearance_cost(body, margin_m=0.2, weight=10.0)
        # near(field, variable) is a jaxls.Cost; see clearance_constraint.

    Args:
        spheres: As for `clearance_constraint`.
        margin_m: Clearance from which there is no cost, m, > 0.
        weight: Per m, > 0.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (field, variable) -> the cost, as for `clearance_constraint`.

    Raises:
        ValueError: The margin or the weight is not positive and finite.
    """
    margin_m = as_number("margin_m", margin_m, 0, above=True)
    weight = as_number("weight", weight, 0, above=True)

    def shortfall(clearance: jax.Array, jacobian: jax.Array) -> tuple[jax.Array, jax.Array]:
        # The square of the 1e30 m of NaN points would overflow.
        short = jnp.minimum(margin_m - clearance, 1e6)
        near = short > 0
        return jnp.where(near, weight * short, 0), jnp.where(near[:, None], -weight * jacobian, 0)

    return _by_map(spheres, shortfall, "l2_squared", "clearance_cost", unknown, bound)


def _by_map(
    spheres: VariableSpheres,
    residual: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]],
    kind: str,
    name: str,
    unknown: Unknown,
    bound: Bound,
) -> Callable[[AnyField, Var], Cost]:
    """Makes costs of clearances (S,) and their Jacobian (S, n), by a map and a variable."""

    def make(field: AnyField, variable: Var) -> Cost:
        retract, tangents = type(variable).retract_fn, type(variable).tangent_dim

        # The map is not an argument of the cost: jaxls would copy it for each variable.
        def compute(values: Any, variable: Var) -> tuple[jax.Array, jax.Array]:
            value = values[variable]

            def moved(tangent: jax.Array) -> tuple[jax.Array, Any]:
                return spheres(retract(value, tangent))

            return residual(
                *clearance_and_jacobian(field, moved, jnp.zeros(tangents), unknown, bound)
            )

        # jaxls keeps the second result of `compute` and asks for it when it needs the Jacobian.
        factory = Cost.factory(
            kind=kind, jac_custom_with_cache_fn=lambda _, jacobian, __: jacobian, name=name
        )
        return factory(compute)(variable)

    return make
