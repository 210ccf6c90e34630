"""Trajectory optimization: many initial guesses, all optimized at once on the map."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scene import build_map, exact_sdf

import hiosdf_jax as hio
from hiosdf_jax import planning

RADIUS = 0.15  # m, of the ball that has to pass
QUERIES = (((2.4, 3.5, 0.6), (3.5, 2.4, 0.6)), ((0.4, 0.5, 0.8), (3.4, 2.2, 0.4)))  # m


@functools.partial(jax.jit, static_argnames="count")
def plan(field, start_world, goal_world, key, count=64):
    """Returns the shortest optimized path that is clear, or else the clearest."""
    guesses = planning.waves(key, start_world, goal_world, count, waypoints=32, spread_m=0.4)
    paths = planning.optimize_trajectory(field, guesses, radius_m=RADIUS, margin_m=0.12)
    # Lengths are below 100 m: any clear path beats any that is not.
    best = jnp.argmin(jnp.where(paths.clearance > 0.05, paths.length, 100 - paths.clearance))
    return jax.tree.map(lambda x: x[best], paths)


def exact_clearance(waypoints_world):
    """Returns the least exact clearance of the ball along the path, m, 10 samples per segment."""
    share = np.linspace(0, 1, 11)[:, None]
    waypoints = np.asarray(waypoints_world, float)
    dense = waypoints[:-1, None] + share * (waypoints[1:] - waypoints[:-1])[:, None]
    return (exact_sdf(dense) - RADIUS).min()


if __name__ == "__main__":
    field = hio.snapshot(build_map())
    for start, goal in QUERIES:
        line = np.linspace(start, goal, 32)
        path = plan(field, jnp.array(start), jnp.array(goal), jax.random.key(0))
        print(
            f"straight line: {np.linalg.norm(line[-1] - line[0]):.2f} m, "
            f"clearance {exact_clearance(line):.3f} m; optimized: {path.length:.2f} m, "
            f"clearance {exact_clearance(path.waypoints_world):.3f} m"
        )
