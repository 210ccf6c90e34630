"""A round robot on a differential drive: its motion, its body and its clearance in a map."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.field.queries import AnyField, Unknown, sdf
from hiosdf_jax._src.numerics.gradient import least

_SUBSTEPS = 4  # integration steps per control step


@dataclasses.dataclass(frozen=True)
class Robot:
    """A vertical capsule on a differential drive; the state is (x, y, yaw, speed, turn rate).

    Attributes:
        heights: Heights of the body's spheres above the world's origin, m.
        radius: Radius of these spheres, m.
        max_speed: Forward speed, m/s. The robot never drives backward, where it does not look.
        max_turn_rate: rad/s.
        max_acceleration: m/s^2, speeding up and braking.
        max_turn_acceleration: rad/s^2.
        margin: Clearance that the guard enforces, m.
        comfort: Clearance below which driving costs more, m.
        step: Length of a control step, s.
    """

    heights: tuple[float, ...]
    radius: float = 0.2
    max_speed: float = 0.6
    max_turn_rate: float = 1.5
    max_acceleration: float = 1.0
    max_turn_acceleration: float = 4.0
    margin: float = 0.04
    comfort: float = 0.15
    step: float = 0.2


@partial(jax.jit, static_argnums=0)
def motion(robot: Robot, state: jax.Array, control: jax.Array) -> jax.Array:
    """Simulates one control step.

    Args:
        robot: The robot.
        state: (5,) x, y (m), yaw (rad), speed (m/s), turn rate (rad/s).
        control: (2,) acceleration (m/s^2) and turn acceleration (rad/s^2), clipped to the robot's
            limits.

    Returns:
        (4, 5) states at even times; the last is the state after the step.
    """
    limit = jnp.array([robot.max_acceleration, robot.max_turn_acceleration])
    acceleration, turn_acceleration = jnp.clip(control, -limit, limit)
    x, y, yaw, speed, rate = state
    states = []
    dt = robot.step / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        speed = jnp.clip(speed + dt * acceleration, 0, robot.max_speed)
        rate = jnp.clip(rate + dt * turn_acceleration, -robot.max_turn_rate, robot.max_turn_rate)
        yaw = yaw + dt * rate
        x, y = x + dt * speed * jnp.cos(yaw), y + dt * speed * jnp.sin(yaw)
        states.append(jnp.stack([x, y, yaw, speed, rate]))
    return jnp.stack(states)


def braking(robot: Robot, state: jax.Array) -> jax.Array:
    """Returns the control that comes nearest to a stop within one step.

    Args:
        robot: The robot.
        state: (5,).

    Returns:
        (2,) acceleration, turn acceleration.
    """
    limit = jnp.array([robot.max_acceleration, robot.max_turn_acceleration])
    return jnp.clip(-state[3:] / robot.step, -limit, limit)


def clearance(robot: Robot, field: AnyField, states: jax.Array, unknown: Unknown) -> jax.Array:
    """Computes the clearance of a robot's body in a map.

    Args:
        robot: The robot.
        field: The map.
        states: (..., 5), or their first two components.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.

    Returns:
        (...) m; negative in collision.
    """
    return least(sdf(field, body(robot, states), unknown)) - robot.radius


def body(robot: Robot, states: Any) -> jax.Array:
    """Places the spheres of a robot's body.

    Args:
        robot: The robot.
        states: (..., 5), or their first two components.

    Returns:
        Centers, (..., S, 3) m, world.
    """
    states = jnp.asarray(states)
    heights = jnp.asarray(robot.heights, jnp.float32)
    xy = jnp.broadcast_to(states[..., None, :2], (*states.shape[:-1], len(heights), 2))
    z = jnp.broadcast_to(heights, xy.shape[:-1])
    return jnp.concatenate([xy, z[..., None]], axis=-1)
