"""Clearance of a body's spheres by its configuration, with the Jacobian that optimizers take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.planning.clearance import sphere_clearance_and_grad
from hiosdf_jax._src.state.pytrees import Bound

BodySpheres = Callable[[jax.Array], tuple[jax.Array, Any]]
"""Configuration (n,) -> the body's spheres: centers_world (S, 3) m and radii (S,) m."""


def clearance_and_jacobian(
    field: AnyField,
    spheres: BodySpheres,
    q: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array]:
    """Computes the clearance of each sphere of a body, and its Jacobian by the configuration.

    The map is queried once: d(clearance_i)/dq = grad sdf(center_i) . d(center_i)/dq, with the
    kinematics differentiated in forward mode.

    Example:
        def body(q):  # two balls at the ends of a bar that turns in the plane z = 0.5
            tip = jnp.stack([jnp.cos(q[0]), jnp.sin(q[0]), 0.5])
            return jnp.stack([jnp.array([0.0, 0.0, 0.5]), tip]), jnp.array([0.1, 0.2])

        clearance, jacobian = planning.clearance_and_jacobian(field, body, jnp.array([0.3]))

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        spheres: The body at a configuration, a pure function of JAX arrays; the radii do not
            depend on the configuration.
        q: (n,) m or rad. Use vmap for many configurations.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        clearance (S,) float32, m, and d(clearance)/dq (S, n) float32, m/m or m/rad.

    Raises:
        ValueError: A shape is wrong, or (outside jit) a radius is negative or not finite.
    """
    q = on_device("q", q)
    if q.ndim != 1:
        raise ValueError(f"q has shape {q.shape}, expected (n,); use vmap for many configurations")

    def placed(q: jax.Array) -> tuple[jax.Array, tuple[jax.Array, Any]]:
        centers_world, radii = spheres(q)
        return centers_world, (centers_world, radii)

    by_configuration, (centers_world, radii) = jax.jacfwd(placed, has_aux=True)(q)
    clearance, grad = sphere_clearance_and_grad(field, centers_world, radii, unknown, bound)
    return clearance, jnp.einsum("si,sin->sn", grad, by_configuration.astype(jnp.float32))
