"""MPPI (Williams et al., ICRA 2017) by jax-mppi, with the map as an argument."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax_mppi  # pyright: ignore[reportMissingImports]

Controller = Callable[[jax_mppi.MPPIState, Any, Any], tuple[jax.Array, jax_mppi.MPPIState]]


def controller(
    settings: jax_mppi.MPPIConfig,
    dynamics: Callable[..., jax.Array],
    running_cost: Callable[..., jax.Array],
    terminal_cost: Callable[..., jax.Array] | None = None,
) -> Controller:
    """Compiles one MPPI step whose costs take a map that may change at every step.

    A cost that closes over a map keeps the map that it was compiled with. Here the costs close over
    a traced argument, so that one compilation serves all maps of one configuration.

    Example:
        settings, plan = jax_mppi.create(
            nx=3, nu=3, noise_sigma=0.2 * jnp.eye(3), num_samples=128, horizon=10
        )

        def dynamics(position, velocity):
            return position + 0.1 * velocity

        def cost(field, position, velocity):
            clearance = planning.sphere_clearance(field, position, radii=0.2)
            to_goal = jnp.sum((position - jnp.array([2.0, 0.0, 0.5])) ** 2)
            return to_goal + 100 * planning.collision_cost(clearance, margin_m=0.1)

        step = planning.mppi.controller(settings, dynamics, cost)
        velocity, plan = step(plan, jnp.zeros(3), field)

    Args:
        settings: From `jax_mppi.create`.
        dynamics: (state (nx,), control (nu,)) -> next state (nx,). It takes the index of the step
            as a third argument if `settings.step_dependent_dynamics`.
        running_cost: (world, state (nx,), control (nu,)) -> () cost, with the index as above.
        terminal_cost: (world, state (nx,), control (nu,)) -> () cost.

    Returns:
        (mppi_state, state (nx,), world) -> control, new mppi_state. The control is (nu,), or
        (u_per_command, nu) for u_per_command > 1. `mppi_state` comes from `jax_mppi.create`.
        `world` is any pytree of arrays, for example a map, or a map and a goal.
    """

    @jax.jit
    def step(
        mppi_state: jax_mppi.MPPIState, state: jax.Array, world: Any
    ) -> tuple[jax.Array, jax_mppi.MPPIState]:
        return jax_mppi.command(
            settings,
            mppi_state,
            state,
            dynamics,
            partial(running_cost, world),
            None if terminal_cost is None else partial(terminal_cost, world),
        )

    return step
