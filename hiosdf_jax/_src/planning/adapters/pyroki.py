"""The collision geometry of a `pyroki` robot as spheres, for costs and constraints on a map."""

# Without pyroki, pyright resolves the import to this module itself.
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from pyroki.collision import Capsule, Sphere  # pyright: ignore[reportMissingImports]

from hiosdf_jax._src.numerics.intake import check_whole, is_traced
from hiosdf_jax._src.planning.body import BodySpheres

if TYPE_CHECKING:
    from pyroki import Robot  # pyright: ignore[reportMissingImports]
    from pyroki.collision import RobotCollision  # pyright: ignore[reportMissingImports]


def robot_spheres(
    robot: Robot,
    collision: RobotCollision,
    *,
    ignore: Collection[str] = (),
    spheres_per_capsule: int = 5,
) -> BodySpheres:
    """Makes the function that places a robot's collision spheres, for `planning.jaxls`.

    A capsule becomes spheres along its axis that cover it. With n spheres on an axis of length l,
    they are wider than the capsule of radius r: sqrt(r^2 + (l / (2 n - 2))^2).

    Example:
        body = planning.pyroki.robot_spheres(robot, collision, ignore=["base"])
        near = planning.jaxls.clearance_cost(body, margin_m=0.1, weight=10.0)
        clear = planning.jaxls.clearance_constraint(body, margin_m=0.02)
        # near(field, robot.joint_var_cls(0)) is a cost among those of pyroki.
        centers_world, radii = body(jnp.zeros(2))

    Args:
        robot: The kinematics.
        collision: `RobotCollision.from_urdf` (capsules) or `.from_sphere_decomposition` (spheres).
        ignore: Names of links to leave out, such as a base that always touches what it stands on.
        spheres_per_capsule: >= 2.

    Returns:
        q (..., actuated joints), rad or m -> centers_world (..., S, 3) m and radii (S,) m.

    Raises:
        ValueError: `ignore` names a link that the robot lacks, no sphere is left, the geometry is
            neither spheres nor capsules, or this is called inside jit.
    """
    check_whole("spheres_per_capsule", spheres_per_capsule, 2)
    names = list(collision.link_names)
    unknown_links = sorted(set(ignore) - set(names))
    if unknown_links:
        raise ValueError(f"ignore has {unknown_links}, expected names of links: {names}")
    geometry = collision.coll
    if not isinstance(geometry, Sphere | Capsule):
        raise ValueError(
            f"collision has {type(geometry).__name__} geometry, expected spheres or capsules"
        )
    if is_traced(geometry.size):
        raise ValueError("collision is traced; call robot_spheres outside jit, its result inside")
    capsules = isinstance(geometry, Capsule)
    along = np.linspace(-0.5, 0.5, spheres_per_capsule if capsules else 1, dtype=np.float32)
    # (links, geometries of a link, spheres of a geometry); pyroki fills up with radii of zero.
    size = np.asarray(geometry.size, float).reshape(len(names), -1, np.shape(geometry.size)[-1])
    spacing = size[..., 1] / (len(along) - 1) if capsules else 0.0
    radii = np.sqrt(size[..., 0] ** 2 + (spacing / 2) ** 2)
    kept = (size[..., 0] > 0) & ~np.isin(names, list(ignore))[:, None]
    if not kept.any():
        raise ValueError("collision has no sphere on the links that are left, expected some")
    radii = jnp.asarray(np.repeat(radii[kept], len(along)), jnp.float32)

    def body(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        posed = collision.at_config(robot, q)
        centers = posed.pose.translation()[..., None, :]
        if capsules:
            offsets = along[:, None] * posed.height[..., None, None]
            centers = centers + offsets * posed.axis[..., None, :]
        batch = jnp.shape(q)[:-1]
        centers = centers.reshape(*batch, *kept.shape, len(along), 3)[..., *np.nonzero(kept), :, :]
        return centers.reshape(*batch, -1, 3), radii

    return body
