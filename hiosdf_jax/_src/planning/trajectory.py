"""Trajectory optimisation: an elastic band that the map's gradients push off its surfaces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from hiosdf_jax._src.field.points import AnyField, Unknown, sdf_and_grad
from hiosdf_jax._src.numerics.gradient import least

# Points at which each segment is held off the map; the last one is its end.
_SAMPLES_PER_SEGMENT = 4

# Weight of the squared intrusion, 1/m^2, against the band's energy relative to the straight line's.
_INTRUSION_WEIGHT = 2000.0


class Trajectory(NamedTuple):
    """A path between two points.

    Attributes:
        waypoints_world: (..., N, 3) m.
        clearance: Least distance to the map along the path, less the radius, (...) m.
        length: (...) m.
    """

    waypoints_world: jax.Array
    clearance: jax.Array
    length: jax.Array


def waves(
    key: jax.Array, start_world: Any, goal_world: Any, count: int, waypoints: int, spread_m: float
) -> jax.Array:
    """Draws first guesses: straight lines with one, two and three half waves laid over them.

    An optimiser that follows gradients keeps to the side of an obstacle that it begins on: draw
    many, optimise them all, and take the shortest that is clear.

    Args:
        key: Source of the randomness.
        start_world: (3,) m.
        goal_world: (3,) m.
        count: How many; the first one is the straight line.
        waypoints: Points of each, ends included.
        spread_m: Standard deviation of the height of each wave, along each axis.

    Returns:
        (count, waypoints, 3) m.
    """
    start, goal = jnp.asarray(start_world, jnp.float32), jnp.asarray(goal_world, jnp.float32)
    along = jnp.linspace(0, 1, waypoints)[:, None]
    heights = spread_m * jax.random.normal(key, (count, 3, 3)).at[0].set(0)
    shapes = jnp.sin(jnp.pi * along * jnp.arange(1, 4))
    return start + along * (goal - start) + shapes @ heights


def optimize_trajectory(
    field: AnyField,
    initial_world: Any,
    *,
    radius_m: float,
    margin_m: float = 0.1,
    steps: int = 300,
    step_m: float = 0.05,
    unknown: Unknown = "obstacle",
) -> Trajectory:
    """Shortens paths and pushes them off the map, by Adam on the map's distances and gradients.

    The cost is that of CHOMP (Ratliff et al., ICRA 2009) in its simplest form: the energy of the
    band, (N - 1) sum |x_{i+1} - x_i|^2 relative to the straight line's, and the mean square of how
    far samples along it intrude into radius + margin.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        initial_world: (..., N, 3) m, N >= 3; the ends stay where they are.
        radius_m: Radius of the ball that follows the path.
        margin_m: Clearance that is wanted beyond it; it is soft.
        steps: Steps of Adam.
        step_m: Its learning rate: the most that a waypoint moves in a step, about. It decays.
        unknown: What to make of space that no ray has reached, as for `sdf`.

    Returns:
        The paths, each from its own first guess.

    Raises:
        ValueError: An argument is not what it should be.
    """
    initial = jnp.asarray(initial_world, jnp.float32)
    if initial.ndim < 2 or initial.shape[-1] != 3 or initial.shape[-2] < 3:
        raise ValueError(f"initial_world has shape {initial.shape}, expected (..., N >= 3, 3)")
    for name, value in (("radius_m", radius_m), ("margin_m", margin_m)):
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is {value!r}, expected >= 0")
    wanted = radius_m + margin_m
    segments = initial.shape[-2] - 1
    straight = jnp.maximum(_length(initial[..., -1, :] - initial[..., 0, :]), 1e-3)
    inner = jnp.ones((segments + 1, 1)).at[jnp.array([0, -1])].set(0)

    def gradient(path: jax.Array) -> jax.Array:
        samples_world = jax.lax.stop_gradient(_along(path))
        distance, normal = sdf_and_grad(field, samples_world, unknown)

        def cost(path: jax.Array) -> jax.Array:
            # The map to first order: exact for the gradient, and asked only once.
            moved = _along(path) - samples_world
            intrusion = jax.nn.relu(wanted - distance - jnp.sum(normal * moved, axis=-1))
            spacing = _length(jnp.diff(path, axis=-2))
            stretch = segments * jnp.sum(spacing**2, axis=-1) / straight**2
            per_segment = jnp.reshape(intrusion[..., 1:] ** 2, (*spacing.shape, -1)).mean(-1)
            return jnp.sum(
                stretch + _INTRUSION_WEIGHT * jnp.sum(per_segment * spacing, axis=-1) / straight
            )

        return inner * jax.grad(cost)(path)

    adam = optax.adam(optax.cosine_decay_schedule(step_m, steps))

    def step(carry: tuple[jax.Array, Any], _: None) -> tuple[tuple[jax.Array, Any], None]:
        path, memory = carry
        update, memory = adam.update(gradient(path), memory)
        return (jnp.asarray(optax.apply_updates(path, update)), memory), None

    (path, _), _ = jax.lax.scan(step, (initial, adam.init(initial)), length=steps)
    clearance = least(sdf_and_grad(field, _along(path), unknown)[0]) - radius_m
    return Trajectory(path, clearance, jnp.sum(_length(jnp.diff(path, axis=-2)), axis=-1))


def _length(vectors: jax.Array) -> jax.Array:
    # The root has no derivative at 0, where two waypoints coincide.
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1) + 1e-12)


def _along(path: jax.Array) -> jax.Array:
    """Samples evenly spaced along each segment, (..., N, 3) -> (..., 1 + (N - 1) k, 3)."""
    share = (jnp.arange(_SAMPLES_PER_SEGMENT) + 1)[:, None] / _SAMPLES_PER_SEGMENT
    begin, end = path[..., :-1, None, :], path[..., 1:, None, :]
    inner = begin + share * (end - begin)
    return jnp.concatenate([path[..., :1, :], inner.reshape(*path.shape[:-2], -1, 3)], axis=-2)
