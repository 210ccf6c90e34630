"""Whole-arm clearance of a `frax` manipulator, whose links carry collision spheres."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.numerics.gradient import least, value_and_gradient
from hiosdf_jax._src.numerics.intake import as_array
from hiosdf_jax._src.planning.clearance import sphere_clearance
from hiosdf_jax._src.state.pytrees import Bound

if TYPE_CHECKING:
    from frax import Manipulator


def arm_spheres(
    arm: Manipulator, q: Any, pose_world_base: Any = None
) -> tuple[jax.Array, jax.Array]:
    """Places the collision spheres of an arm's moving links.

    Spheres of the base are left out: they cannot move, and would always touch what it stands on.

    Args:
        arm: A frax robot with collision data, such as `frax.load_panda()`; static under jit.
        q: (..., n) joint positions, rad or m.
        pose_world_base: (4, 4) T_world_base, m; the identity if None.

    Returns:
        centers_world (..., S, 3) m and radii (S,) m.

    Raises:
        ValueError: The arm has no collision data, or a shape is wrong.
    """
    q = jnp.asarray(as_array("q", q))
    if not arm.has_collision_data:
        raise ValueError("arm has no collision data, expected spheres on its links")
    if q.ndim == 0 or q.shape[-1] != arm.nq:
        raise ValueError(f"q has shape {q.shape}, expected (..., {arm.nq})")
    pose = (
        jnp.eye(4)
        if pose_world_base is None
        else jnp.asarray(as_array("pose_world_base", pose_world_base))
    )
    if pose.shape != (4, 4):
        raise ValueError(f"pose_world_base has shape {pose.shape}, expected (4, 4)")
    flat = jax.vmap(arm.link_collision_positions)(q.reshape(-1, arm.nq))
    centers_base = flat.reshape(*q.shape[:-1], -1, 3)
    centers_world = jnp.einsum("ij,...j->...i", pose[:3, :3], centers_base) + pose[:3, 3]
    return centers_world, jnp.asarray(arm.flat_collision_radii, jnp.float32)


def arm_clearance(
    field: AnyField,
    arm: Manipulator,
    q: Any,
    pose_world_base: Any = None,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> jax.Array:
    """Computes the clearance of the nearest of an arm's moving links.

    Example:
        arm = frax.load_panda()
        arm_clearance = jax.jit(planning.frax.arm_clearance, static_argnames=("arm", "unknown"))
        clearance = arm_clearance(field, arm, jnp.zeros((10, 7)))

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        arm: As for `arm_spheres`.
        q: (..., n) joint positions, rad or m.
        pose_world_base: (4, 4) T_world_base, m; the identity if None.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (...) float32, m: the least sdf(center) - radius, negative in collision. Differentiable.

    Raises:
        ValueError: As for `arm_spheres`.
    """
    centers_world, radii = arm_spheres(arm, q, pose_world_base)
    return least(sphere_clearance(field, centers_world, radii, unknown, bound))


def arm_clearance_and_grad(
    field: AnyField,
    arm: Manipulator,
    q: Any,
    pose_world_base: Any = None,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array]:
    """Computes `arm_clearance` and its gradient, by one reverse-mode evaluation for the batch.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        arm: As for `arm_spheres`.
        q: (..., n) joint positions, rad or m.
        pose_world_base: (4, 4) T_world_base, m; the identity if None.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        The clearance (...) float32, m, and d(clearance)/dq (..., n) float32, m/rad or m/m.

    Raises:
        ValueError: As for `arm_spheres`.
    """
    q = jnp.asarray(as_array("q", q))
    return value_and_gradient(
        lambda q: arm_clearance(field, arm, q, pose_world_base, unknown, bound), q
    )
