"""Rollouts of a robot in MJX, with the centers of its spheres: a cost queries the map once."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from hiosdf_jax._src.numerics.intake import as_array, check_whole


class Rollout(NamedTuple):
    """States after each control.

    Attributes:
        qpos: Generalized positions, (..., H, nq), m or rad.
        qvel: Generalized velocities, (..., H, nv), per second.
        centers_world: Centers of the chosen geoms, (..., H, S, 3) m.
    """

    qpos: jax.Array
    qvel: jax.Array
    centers_world: jax.Array


def sphere_geoms(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Finds the sphere geoms of a model's moving bodies.

    Args:
        model: The robot.

    Returns:
        Indices (S,) int and radii (S,) float32, m.

    Raises:
        ValueError: The model has none.
    """
    spheres = model.geom_type == int(mujoco.mjtGeom.mjGEOM_SPHERE)
    geoms = np.flatnonzero(spheres & (model.body_weldid[model.geom_bodyid] != 0))
    if geoms.size == 0:
        raise ValueError(f"model has {model.ngeom} geoms, expected spheres on a moving body")
    return geoms, model.geom_size[geoms, 0].astype(np.float32)


def rollout(
    model: mjx.Model,
    data: mjx.Data,
    controls: jax.Array,
    geoms: np.ndarray,
    steps_per_control: int = 1,
) -> Rollout:
    """Simulates control sequences from one state, in parallel.

    Args:
        model: The robot, `mjx.put_model(model)`.
        data: The initial state.
        controls: (..., H, nu), each held for `steps_per_control` simulation steps.
        geoms: (S,) indices of the geoms to place, see `sphere_geoms`.
        steps_per_control: >= 1.

    Returns:
        The states after each control.

    Raises:
        ValueError: `controls` has a wrong shape, or `steps_per_control` < 1.
    """
    controls = jnp.asarray(as_array("controls", controls))
    if controls.ndim < 2 or controls.shape[-1] != model.nu:
        raise ValueError(f"controls has shape {controls.shape}, expected (..., H, {model.nu})")
    check_whole("steps_per_control", steps_per_control, 1)

    def hold(state: mjx.Data, control: jax.Array) -> tuple[mjx.Data, Rollout]:
        state = state.replace(ctrl=control)
        state = jax.lax.fori_loop(0, steps_per_control, lambda _, s: mjx.step(model, s), state)
        # A step does not update the geoms.
        placed = mjx.kinematics(model, state)
        return state, Rollout(state.qpos, state.qvel, placed.geom_xpos[jnp.asarray(geoms)])

    flat = controls.reshape(-1, *controls.shape[-2:])
    result = jax.vmap(lambda sequence: jax.lax.scan(hold, data, sequence)[1])(flat)
    return jax.tree.map(lambda x: x.reshape(*controls.shape[:-2], *x.shape[1:]), result)
