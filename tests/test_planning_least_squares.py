"""The recipe for optimistix: a path by least squares, with the map as an argument."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from analytic import baked, count_traces

from hiosdf_jax import planning


def test_paths_around_two_balls_with_one_compilation():
    guess = jnp.linspace(jnp.zeros(3), jnp.array([2.0, 0.0, 0.0]), 12)

    def residuals(inner, field):
        path = jnp.concatenate([guess[:1], inner, guess[-1:]])
        short = 0.05 - planning.sphere_clearance(field, inner, 0.2)
        return jnp.diff(path, axis=0), 10 * jnp.clip(short, 0, 10)

    counted, traces = count_traces(residuals)

    @jax.jit
    def shorten(field, inner):
        solver = optimistix.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
        return optimistix.least_squares(counted, solver, inner, args=field, throw=False).value

    for side in (-1, 1):
        center = np.array([1.0, 0.1 * side, 0.0])

        def ball(points, center=center):
            return np.linalg.norm(points - center, axis=-1) - 0.3

        field = baked(ball, [-1, -1.5, -0.1], [3, 1.5, 0.1], 0.1)
        inner = np.asarray(shorten(field, guess[1:-1]))
        assert ball(np.asarray(guess)).min() < 0.2 < ball(inner).min()
        assert np.sign(inner[5, 1]) == -side
    assert len(traces) == 1
