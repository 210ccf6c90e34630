"""Trajectory optimization: an elastic band that the map's gradients push off surfaces."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from hiosdf_jax._src.field.queries import AnyField, Unknown, distance_and_grad
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.gradient import least
from hiosdf_jax._src.numerics.intake import as_key, as_number, check_whole, is_traced
from hiosdf_jax._src.numerics.modes import plain, varying_like
from hiosdf_jax._src.numerics.vectors import length, split
from hiosdf_jax._src.state.pytrees import Bound

# Samples per segment that are held off the map; the last one is the segment's end.
_SAMPLES_PER_SEGMENT = 4

# Weight of the squared intrusion, 1/m^2. The band's energy is relative to the straight line's.
_INTRUSION_WEIGHT = 2000.0

_MOST_POINTS = 2**31 // 3  # whose coordinates an int32 counts


class Trajectory(NamedTuple):
    """A path between two points.

    Attributes:
        waypoints_world: (..., N, 3) m.
        clearance: Least clearance of the ball along the path, (...) m.
        length: Length of the path, (...) m.
    """

    waypoints_world: jax.Array
    clearance: jax.Array
    length: jax.Array


@plain
def waves(
    key: jax.Array, start_world: Any, goal_world: Any, count: int, waypoints: int, spread_m: float
) -> jax.Array:
    """Draws initial guesses: straight lines with one, two and three half waves added.

    A gradient-based optimizer keeps to the side of an obstacle that it starts on. Draw many
    guesses, optimize them all, and take the shortest one that is clear.

    Args:
        key: Source of the randomness.
        start_world: (3,) m.
        goal_world: (3,) m.
        count: Number of guesses; the first is the straight line.
        waypoints: Points per guess, ends included.
        spread_m: Standard deviation of each wave's height along each axis.

    Returns:
        (count, waypoints, 3) m.

    Raises:
        ValueError: A shape or a type is wrong, or a number is out of range.

    Example:
        start_world, goal_world = jnp.array([0.0, 0.0, 0.5]), jnp.array([2.0, 1.0, 0.5])
        guesses = planning.waves(
            jax.random.key(0), start_world, goal_world, count=16, waypoints=32, spread_m=0.3
        )
    """
    key = as_key("key", key)
    start, goal = on_device("start_world", start_world), on_device("goal_world", goal_world)
    for name, ends in (("start_world", start), ("goal_world", goal)):
        if ends.shape != (3,):
            raise ValueError(f"{name} has shape {ends.shape}, expected (3,)")
    check_whole("count", count, 1)
    check_whole("waypoints", waypoints, 2)
    if count * waypoints > _MOST_POINTS:
        raise ValueError(
            f"count is {count} and waypoints is {waypoints}, expected a product of at most "
            f"{_MOST_POINTS}"
        )
    if not is_traced(spread_m):
        spread_m = as_number("spread_m", spread_m, 0)
    along = jnp.linspace(0, 1, waypoints, dtype=jnp.float32)[:, None]
    heights = spread_m * jax.random.normal(key, (count, 3, 3), jnp.float32).at[0].set(0)
    shapes = jnp.sin(jnp.pi * along * jnp.arange(1, 4, dtype=jnp.float32))
    return start + along * (goal - start) + shapes @ heights


@plain
def optimize_trajectory(
    field: AnyField,
    initial_world: Any,
    *,
    radius_m: float,
    margin_m: float = 0.1,
    steps: int = 300,
    step_m: float = 0.05,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> Trajectory:
    """Shortens paths and pushes them off the map, by Adam on the map's distances and gradients.

    The cost is that of CHOMP (Ratliff et al., ICRA 2009) in its simplest form: the energy of the
    band, (N - 1) sum |x_{i+1} - x_i|^2 relative to the straight line's, plus the mean squared
    intrusion of samples along it into radius + margin.

    Example:
        start_world, goal_world = jnp.array([0.0, 0.0, 0.5]), jnp.array([2.0, 1.0, 0.5])
        guesses = planning.waves(
            jax.random.key(0), start_world, goal_world, count=16, waypoints=32, spread_m=0.3
        )
        paths = planning.optimize_trajectory(field, guesses, radius_m=0.15)
        best = jnp.argmin(jnp.where(paths.clearance > 0, paths.length, jnp.inf))
        waypoints_world = paths.waypoints_world[best]

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        initial_world: (..., N, 3) m, N >= 3; the ends stay where they are.
        radius_m: Radius of the ball that follows the path.
        margin_m: Clearance to aim for; a soft constraint.
        steps: Steps of Adam.
        step_m: Adam's learning rate, about the most that a waypoint moves per step. It decays.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        The optimized paths, one per guess.

    Raises:
        ValueError: `initial_world` has a wrong shape or type, or a number is out of range.
    """
    initial = on_device("initial_world", initial_world)
    if initial.ndim < 2 or initial.shape[-1] != 3 or initial.shape[-2] < 3:
        raise ValueError(f"initial_world has shape {initial.shape}, expected (..., N >= 3, 3)")
    radius_m, margin_m = as_number("radius_m", radius_m, 0), as_number("margin_m", margin_m, 0)
    if not is_traced(step_m):
        step_m = as_number("step_m", step_m, 0, above=True)
    check_whole("steps", steps, 1)
    wanted = radius_m + margin_m
    segments = initial.shape[-2] - 1
    straight = jnp.maximum(length(split(initial[..., -1, :] - initial[..., 0, :])), 1e-3)
    inner = jnp.ones((segments + 1, 1), jnp.float32).at[jnp.array([0, -1])].set(0)

    def gradient(path: jax.Array) -> jax.Array:
        samples_world = jax.lax.stop_gradient(_along(path))
        distance, normal = distance_and_grad(field, samples_world, unknown, bound)

        def cost(path: jax.Array) -> jax.Array:
            # The map to first order: exact for the gradient, with one query.
            moved = _along(path) - samples_world
            intrusion = jax.nn.relu(wanted - distance - jnp.sum(normal * moved, axis=-1))
            spacing = length(split(jnp.diff(path, axis=-2)))
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

    start = varying_like((initial, adam.init(initial)), field, initial)
    (path, _), _ = jax.lax.scan(step, start, length=steps)
    clearance = least(distance_and_grad(field, _along(path), unknown, bound)[0]) - radius_m
    return Trajectory(path, clearance, jnp.sum(length(split(jnp.diff(path, axis=-2))), axis=-1))


def _along(path: jax.Array) -> jax.Array:
    """Samples each segment evenly, (..., N, 3) -> (..., 1 + (N - 1) k, 3)."""
    share = (jnp.arange(_SAMPLES_PER_SEGMENT, dtype=jnp.float32) + 1)[
        :, None
    ] / _SAMPLES_PER_SEGMENT
    begin, end = path[..., :-1, None, :], path[..., 1:, None, :]
    inner = begin + share * (end - begin)
    return jnp.concatenate([path[..., :1, :], inner.reshape(*path.shape[:-2], -1, 3)], axis=-2)
