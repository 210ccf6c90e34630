"""Sampling-based control by `hydrax`, with the map as an argument of each step."""

# Without hydrax, pyright resolves the import to this module itself.
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import jax
from hydrax.alg_base import (  # pyright: ignore[reportMissingImports]
    SamplingBasedController,
    Trajectory,
)
from mujoco import mjx

from hiosdf_jax._src.field.queries import AnyField


def optimizer(
    controller: SamplingBasedController,
) -> Callable[[mjx.Data, Any, AnyField], tuple[Any, Trajectory]]:
    """Compiles `controller.optimize` with the map as an argument.

    The costs of the controller's task read the map as `self.field`. A task that is given its map
    beforehand keeps the one that it was compiled with. Here a copy of the task gets the map inside
    jit, so that one compilation serves all maps of one configuration. hydrax places the geoms
    before `running_cost`; in `terminal_cost` they are where they were one simulation step earlier.

    Example:
        geoms, radii = planning.mjx.sphere_geoms(model)

        class Hover(hydrax.task_base.Task):
            def running_cost(self, state, control):
                clearance = planning.sphere_clearance(self.field, state.geom_xpos[geoms], radii)
                near = planning.collision_cost(clearance, margin_m=0.2).sum()
                return 100 * near + jnp.sum(control**2)

            def terminal_cost(self, state):
                return jnp.sum((state.qpos - 1.0) ** 2)

        controller = hydrax.algs.MPPI(Hover(model), 32, noise_level=0.5, temperature=0.1)
        optimize = planning.hydrax.optimizer(controller)
        params, rollouts = optimize(mjx.make_data(model), controller.init_params(), field)

    Args:
        controller: Any controller of hydrax. It and its task stay as they are.

    Returns:
        (state, params, field) -> new params, rollouts; as `controller.optimize`.

    Raises:
        ValueError: `controller` is not a controller of hydrax.
    """
    if not isinstance(controller, SamplingBasedController):
        raise ValueError(
            f"controller is a {type(controller).__name__}, expected a SamplingBasedController"
        )

    @jax.jit
    def optimize(state: mjx.Data, params: Any, field: AnyField) -> tuple[Any, Trajectory]:
        bound, bound.task = copy.copy(controller), copy.copy(controller.task)
        bound.task.field = field
        return bound.optimize(state, params)

    return optimize
