"""jax-mppi on maps that change at every step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import baked

import hiosdf_jax as hio

jax_mppi = pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from hiosdf_jax.planning import mppi

RADIUS = 0.3  # m, of the robot
STEP = 0.1  # s
GOAL = jnp.array([2.0, 0.0, 0.0])


def ball_world(center, radius):
    """A map of one ball, all of it observed: 61 x 41 x 3 samples."""
    return baked(
        lambda p: np.linalg.norm(p - np.asarray(center), axis=-1) - radius,
        (-1.0, -2.0, -0.1),
        (5.0, 2.0, 0.1),
        0.1,
    )


def drive(state, control):
    return state + STEP * control


def clear_of(field, state, control):
    depth = jax.nn.relu(RADIUS - hio.sdf(field, state))
    return 1000.0 * depth + 10.0 * jnp.sum((state - GOAL) ** 2)


def make(samples=256, horizon=15):
    return jax_mppi.create(
        nx=3,
        nu=3,
        noise_sigma=jnp.diag(jnp.array([0.5, 0.5, 1e-4])),
        num_samples=samples,
        horizon=horizon,
        u_min=jnp.array([-1.0, -1.0, -0.01]),
        u_max=jnp.array([1.0, 1.0, 0.01]),
        key=jax.random.key(0),
    )


def test_200_maps_compile_once_and_each_takes_effect_at_once():
    settings, plan = make(samples=64, horizon=8)
    traces = 0

    def counted(field, state, control):
        nonlocal traces
        traces += 1
        return clear_of(field, state, control)

    command = mppi.controller(settings, drive, counted)
    # A ball alternately right and left, never twice in the same place. Nominal plan and noise stay
    # the same: only the map differs.
    sides = np.where(np.arange(200) % 2, 1, -1)
    answers = np.empty(200)
    for k, side in enumerate(sides):
        world = ball_world((0.2 + 0.0005 * k, side * 0.4, 0.0), 0.3)
        control, _ = command(plan, jnp.zeros(3), world)
        answers[k] = control[1]
    assert traces == 1
    # Each control evades the ball of its own step, not that of the step before.
    np.testing.assert_array_equal(np.sign(answers), -sides)
    assert np.abs(answers).min() > 0.05


def test_the_cost_is_that_of_the_given_map():
    """The same controls, costed through the adapter and by hand."""
    settings, plan = make(samples=1, horizon=4)
    seen = []

    def spying(field, state, control):
        cost = clear_of(field, state, control)
        jax.debug.callback(lambda s, c: seen.append((np.array(s), float(c))), state, cost)
        return cost

    command = mppi.controller(settings, drive, spying)
    for radius in (0.2, 0.5):
        seen.clear()
        jax.block_until_ready(command(plan, jnp.zeros(3), ball_world((0.1, 0.7, 0.0), radius)))
        jax.effects_barrier()
        assert len(seen) == 4
        for state, cost in seen:
            gap = np.linalg.norm(state - [0.1, 0.7, 0.0]) - radius
            by_hand = 1000 * max(RADIUS - gap, 0) + 10 * np.sum((state - np.array(GOAL)) ** 2)
            assert cost == pytest.approx(by_hand, abs=1000 * 0.012)  # interpolation at 10 cm


def test_a_robot_drives_around_a_ball_that_moves_into_its_path():
    settings, plan = make()
    command = mppi.controller(settings, drive, clear_of, lambda f, s, u: 20 * clear_of(f, s, u))
    state, gaps = jnp.zeros(3), []
    for k in range(60):
        # The ball crosses the straight line to the goal from the left and stays on it.
        center = np.array([1.0, max(1.0 - 0.05 * k, 0.1), 0.0])
        control, plan = command(plan, state, ball_world(center, 0.3))
        state = drive(state, control)
        gaps.append(np.linalg.norm(np.asarray(state) - center) - 0.3)
    assert np.linalg.norm(np.asarray(state - GOAL)) < 0.15
    assert min(gaps) > RADIUS - 0.03


def test_a_terminal_cost_sees_the_map_too():
    settings, plan = make(samples=512, horizon=5)

    def nothing(field, state, control):
        return jnp.zeros(())

    command = mppi.controller(settings, drive, nothing, clear_of)
    left, _ = command(plan, jnp.zeros(3), ball_world((0.5, 0.35, 0.0), 0.3))
    right, _ = command(plan, jnp.zeros(3), ball_world((0.5, -0.35, 0.0), 0.3))
    assert left[1] < -0.1 and right[1] > 0.1
