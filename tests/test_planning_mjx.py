"""Rollouts in MJX: MuJoCo's motions, and a planner compiled once for many maps."""

import jax
import jax.numpy as jnp
import mjx_rollout as example
import mujoco
import numpy as np
import pytest
from analytic import baked
from mujoco import mjx
from scene import ROOM, exact_sdf

from hiosdf_jax import planning

ROVER = (example.ROVER, 64, example.HORIZON)
ARM = (example.ARM, 16, 4)  # its steps take ten times as long
DRIVING = 1024  # rollouts that bring the rover to its goal
BOX = (ROOM[0] - 0.2, ROOM[1] + 0.2, 0.1)  # corners and resolution of all maps, m


CART = """
<mujoco>
  <option timestep="0.02"><flag contact="disable"/></option>
  <worldbody>
    <geom type="sphere" size="0.2" pos="0 0 -5"/>
    <body>
      <joint name="cart" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1" pos="0.1 0 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5"/>
      <body>
        <joint type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="sphere" size="0.05" pos="0 0 -0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="cart" ctrlrange="-9 9"/></actuator>
</mujoco>
"""


def simulate(model, qpos, controls, geoms):
    """Simulates in MuJoCo, float64: positions (H, nq) and centers of the balls (H, S, 3)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    states, centers = [], []
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, example.HOLD)
        mujoco.mj_kinematics(model, data)
        states.append(data.qpos.copy())
        centers.append(data.geom_xpos[geoms].copy())
    return np.array(states), np.array(centers), model.geom_size[geoms, 0]


def random_controls(model, shape, seed):
    low, high = model.actuator_ctrlrange.T
    return np.random.default_rng(seed).uniform(low, high, (*shape, model.nu)).astype(np.float32)


def test_motions_equal_mujocos():
    model = mujoco.MjModel.from_xml_string(CART)
    geoms, radii = planning.mjx.sphere_geoms(model)
    np.testing.assert_array_equal(geoms, [1, 3])
    np.testing.assert_allclose(radii, [0.1, 0.05])
    controls = random_controls(model, (2, 3, 6), 0)
    data = mjx.make_data(model).replace(qpos=jnp.array([0.1, 0.2]))
    run = jax.jit(lambda m, d, c: planning.mjx.rollout(m, d, c, geoms, example.HOLD))
    future = run(mjx.put_model(model), data, controls)
    assert future.qvel.shape == (2, 3, 6, 2)
    for index in np.ndindex(2, 3):
        states, centers, _ = simulate(model, [0.1, 0.2], controls[index], geoms)
        np.testing.assert_allclose(future.qpos[index], states, atol=1e-4)
        np.testing.assert_allclose(future.centers_world[index], centers, atol=1e-4)


def reference_cost(task, model, qpos, controls, exact):
    geoms = np.arange(model.ngeom)  # all of them are spheres
    _, centers, radii = simulate(model, qpos, controls, geoms)
    clearance = exact(centers) - radii
    to_goal = np.linalg.norm(centers[:, -1] - task.goal_world, axis=-1)
    too_near = np.maximum(example.MARGIN - clearance, 0)
    return to_goal.sum() + 200 * too_near.sum() + 1000 * (clearance < 0).sum(), clearance


@pytest.mark.parametrize(("task", "rollouts", "horizon"), [ROVER, ARM], ids=["rover", "arm"])
def test_200_steps_with_200_maps_compile_once_and_the_cost_reacts(task, rollouts, horizon):
    model = example.load(task)
    plan = example.make_planner(model, task.goal_world, rollouts)
    rng = np.random.default_rng(2)
    means = random_controls(model, (200, horizon), 1)
    means[1::2] = means[::2]  # Between the steps of a pair only the map changes.
    qpos, rest = jnp.array(task.qpos), jnp.zeros(model.nv)
    costs, compared = np.zeros(200), 0
    for k in range(200):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        offset = rng.uniform(-0.5, 1.5) - normal @ task.goal_world

        def exact(points, normal=normal, offset=offset):
            return points @ normal + offset

        better, cost = plan(baked(exact, *BOX), qpos, rest, jnp.array(means[k]), jax.random.key(k))
        costs[k] = cost
        assert np.isfinite(better).all()
        if k < 60:
            expected, clearance = reference_cost(task, model, task.qpos, means[k], exact)
            # A ball that just touches may collide in one simulator only.
            if np.abs(clearance).min() > 1e-3:
                np.testing.assert_allclose(cost, expected, rtol=2e-3, atol=0.05)
                compared += 1
    assert compared > 30
    # Pairs of maps without collisions cost the same.
    assert (np.abs(costs[::2] - costs[1::2]) > 1.0).mean() > 0.3
    assert plan._cache_size() == 1


def test_the_rover_reaches_its_goal():
    model = example.load(example.ROVER)
    plan = example.make_planner(model, example.ROVER.goal_world, DRIVING)
    distance, clearance = example.drive(example.ROVER, model, plan, baked(exact_sdf, *BOX))
    assert distance < 0.2
    assert clearance > 0.04
    assert plan._cache_size() == 1


def test_bad_arguments_are_refused():
    model = example.load(example.ROVER)
    robot, data = mjx.put_model(model), mjx.make_data(model)
    with pytest.raises(ValueError, match=r"controls has shape \(4, 2\), expected \(..., H, 3\)"):
        planning.mjx.rollout(robot, data, jnp.zeros((4, 2)), np.array([0]))
    with pytest.raises(ValueError, match="steps_per_control is 0"):
        planning.mjx.rollout(robot, data, jnp.zeros((4, 3)), np.array([0]), 0)
    with pytest.raises(ValueError, match="expected spheres"):
        planning.mjx.sphere_geoms(mujoco.MjModel.from_xml_string("<mujoco/>"))
