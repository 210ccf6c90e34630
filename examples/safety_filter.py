"""A safety filter: the map stops a reckless robot that drives straight at its goals."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from scene import ROOM, build_map, exact_sdf

import hiosdf_jax as hio
from hiosdf_jax import planning

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # cbfpy's advice on CPU setup
    from hiosdf_jax.planning import cbf

RADIUS, SPEED, DT = 0.15, 1.0, 0.05  # m, m/s along each axis, s
# The distance traveled within DT, and 3 cm for the map's error.
MARGIN = 3**0.5 * SPEED * DT + 0.03


def body(position):
    """A ball with six smaller ones inside, which see every wall of a corner."""
    return cbf.inscribed(position[None], jnp.array([RADIUS]))


def make_simulator(steps=80):
    """Returns the jitted (field, starts, goals) -> paths without and with the filter."""
    safe = cbf.velocity_filter(body, [SPEED] * 3, margin_m=MARGIN)

    def reckless(field, position, goal):
        return jnp.clip(10 * (goal - position), -SPEED, SPEED)

    def filtered(field, position, goal):
        return safe(field, position, reckless(field, position, goal))

    @jax.jit
    def simulate(field, starts, goals):
        def path(controller, start, goal):
            def step(position, _):
                position = position + DT * controller(field, position, goal)
                return position, position

            return jax.lax.scan(step, start, length=steps)[1]

        return tuple(
            jax.vmap(path, (None, 0, 0))(controller, starts, goals)
            for controller in (reckless, filtered)
        )

    return simulate


def draw(count, rng, field):
    """Draws safe starts, (count, 3) m, and goals in the room and beyond its walls."""
    starts = rng.uniform(*ROOM, (50 * count, 3)).astype(np.float32)
    known = np.asarray(planning.sphere_clearance(field, starts, RADIUS))
    starts = starts[(exact_sdf(starts) > RADIUS) & (known > MARGIN)][:count]
    return starts, rng.uniform(ROOM[0] - 0.5, ROOM[1] + 0.5, starts.shape).astype(np.float32)


def least_clearance(paths):
    """Returns the least exact clearance of each path, (B,) m."""
    return (exact_sdf(paths) - RADIUS).min(axis=1)


if __name__ == "__main__":
    field = hio.snapshot(build_map())
    starts, goals = draw(200, np.random.default_rng(0), field)
    reckless, filtered = make_simulator()(field, starts, goals)
    for name, paths in (("unfiltered", reckless), ("filtered", filtered)):
        clearance = least_clearance(paths)
        to_goal = np.linalg.norm(paths[:, -1] - goals, axis=1)
        print(
            f"{name}: {(clearance < 0).sum()} of {len(starts)} collide, least clearance "
            f"{clearance.min():.3f} m, median distance to the goal {np.median(to_goal):.2f} m"
        )
