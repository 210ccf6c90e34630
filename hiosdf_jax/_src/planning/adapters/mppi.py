"""MPPI (Williams et al., ICRA 2017) on a map: jax-mppi, with the map as an argument."""

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
    """Compiles one MPPI step whose costs see a world that may differ at every step.

    Costs that close over a map would keep the map they were compiled with. Here they are closed
    over the traced argument, so that one compilation serves all maps of one configuration.

    Args:
        settings: From `jax_mppi.create`.
        dynamics: (state (nx,), control (nu,)) -> next state (nx,); with the index of the step as
            a third argument if `settings.step_dependent_dynamics`.
        running_cost: (world, state (nx,), control (nu,)) -> () cost, and the index as above.
        terminal_cost: (world, state (nx,), control (nu,)) -> () cost.

    Returns:
        (mppi_state, state (nx,), world) -> control, new mppi_state. The control is (nu,), or
        (u_per_command, nu) if that is more than 1. `mppi_state` comes from `jax_mppi.create`;
        `world` is any pytree of arrays: a map, or a map and a goal.
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
