"""The robot's motion, its brakes and its clearance."""

import math

import jax.numpy as jnp
import numpy as np
from analytic import baked
from hypothesis import given, settings
from hypothesis import strategies as st

from hiosdf_jax._src.demo.robot import Robot, braking, clearance, motion

ROBOT = Robot(heights=(0.3, 0.5))


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-3, 3),
    st.floats(0, 0.6),
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
    st.floats(-5, 5),
)
def test_motion_is_that_of_a_finely_integrated_unicycle(yaw, speed, rate, push, twist):
    got = np.asarray(
        motion(ROBOT, jnp.array([1.0, 2.0, yaw, speed, rate]), jnp.array([push, twist]))
    )[-1]
    x, y, fine = 1.0, 2.0, 2000
    dt = ROBOT.step / fine
    push, twist = np.clip(push, -1, 1), np.clip(twist, -4, 4)
    for _ in range(fine):
        speed = min(max(speed + dt * push, 0), 0.6)
        rate = min(max(rate + dt * twist, -1.5), 1.5)
        yaw += dt * rate
        x, y = x + dt * speed * math.cos(yaw), y + dt * speed * math.sin(yaw)
    np.testing.assert_allclose(got[3:], [speed, rate], atol=1e-3)
    # Four substeps are a first-order scheme: an error of half a substep's acceleration.
    np.testing.assert_allclose(got[:3], [x, y, yaw], atol=0.03)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 0.6), st.floats(-1.5, 1.5))
def test_braking_stops_the_robot_within_the_physical_distance(speed, rate):
    state = jnp.array([0.0, 0.0, 0.3, speed, rate])
    for _ in range(math.ceil(0.6 / (1.0 * ROBOT.step))):
        state = motion(ROBOT, state, braking(ROBOT, state))[-1]
    np.testing.assert_allclose(state[3:], 0, atol=1e-6)
    assert float(jnp.hypot(*state[:2])) <= speed**2 / 2 + 0.5 * speed * ROBOT.step + 1e-5


def test_clearance_is_the_least_over_the_body():
    field = baked(lambda p: np.minimum(p[..., 2], 2.5 - p[..., 0]), (0, 0, 0), (4.0, 3.0, 1.0), 0.1)
    states = jnp.array([[1.0, 1.0, 0, 0, 0], [2.1, 1.0, 0, 0, 0]])
    got = clearance(ROBOT, field, states, "network")
    np.testing.assert_allclose(got, [0.3 - 0.2, 0.3 - 0.2], atol=1e-5)
    got = clearance(Robot(heights=(0.9,)), field, states, "network")
    np.testing.assert_allclose(got, [0.7, 0.2], atol=1e-5)
