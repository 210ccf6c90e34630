"""Checks a robot's spheres against the map."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.queries import AnyField, Unknown
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.gradient import least
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax._src.planning.robot.spheres import RobotSpheres, place_spheres
from hiosdf_jax._src.state.pytrees import Bound


@plain
def robot_clearance(
    field: AnyField,
    spheres: RobotSpheres,
    data: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> jax.Array:
    """Computes the least clearance of a robot's spheres in a configuration.

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)
        clearance = planning.robot_clearance(field, spheres, data)

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        spheres: The robot's spheres.
        data: As for `place_spheres`.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (...) float32, m; negative in collision. Differentiable, through `mjx.kinematics` also by
        the joint positions.

    Raises:
        ValueError: As for `place_spheres` and `sphere_clearance`.
    """
    centers_world = place_spheres(spheres, data)
    return least(sphere_clearance(field, centers_world, spheres.radii, unknown, bound))


@plain
def robot_clearance_and_grad(
    field: AnyField,
    spheres: RobotSpheres,
    data: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes the clearance of a robot and its gradient by the motion of each body.

    With the Jacobians of a body, for instance from `mujoco.mj_jacBody`, the gradient by the joints
    is the sum over bodies b of jacp_b^T by_position[b] + jacr_b^T by_rotation[b].

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)
        clearance, by_position, by_rotation = planning.robot_clearance_and_grad(
            field, spheres, data
        )

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        spheres: The robot's spheres.
        data: As for `place_spheres`.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: As for `robot_clearance`.

    Returns:
        The clearance (...) float32, m, and its gradients by the bodies' positions, (..., B, 3), and
        by rotations around the origins of their frames, (..., B, 3) m/rad, world frame.

    Raises:
        ValueError: As for `robot_clearance`.
    """
    xpos = on_device("data.xpos", data.xpos)
    centers_world = place_spheres(spheres, data)
    value, slope = sphere_clearance_and_grad(field, centers_world, spheres.radii, unknown, bound)
    nearest = jnp.arange(value.shape[-1]) == jnp.argmin(value, axis=-1)[..., None]
    force = jnp.where(nearest[..., None], slope, 0)
    torque = jnp.cross(centers_world - xpos[..., spheres.body, :], force)

    def per_body(vectors: jax.Array) -> jax.Array:
        return jnp.zeros_like(xpos).at[..., spheres.body, :].add(vectors)

    return least(value), per_body(force), per_body(jnp.where(nearest[..., None], torque, 0))
