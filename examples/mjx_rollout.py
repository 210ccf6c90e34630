"""Predictive control of a rover and an arm: 1024 MJX rollouts per step, the map in the cost."""

import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from scene import build_map, exact_sdf

import hiosdf_jax as hio
from hiosdf_jax import planning

HORIZON, HOLD = 16, 5  # controls, of 5 steps of 0.02 s
MARGIN = 0.08  # m


class Task(NamedTuple):
    """A robot, its start, the goal of its last ball, and the number of steps of 0.1 s."""

    model: str
    qpos: tuple[float, ...]
    goal_world: tuple[float, float, float]
    steps: int


ROVER = Task("rover.xml", (0.5, 2.0, 0.0), (3.4, 1.0, 0.9), 45)
ARM = Task("arm.xml", (-2.0, -0.6, 0.8, 0.3), (1.75, 2.75, 0.75), 25)


def load(task):
    """Returns the robot's model."""
    return mujoco.MjModel.from_xml_path(str(pathlib.Path(__file__).with_name(task.model)))


def make_planner(model, goal_world, rollouts=1024):
    """Returns the jitted (field, qpos, qvel, mean, key) -> better mean, cost of `mean`."""
    robot, rest = mjx.put_model(model), mjx.make_data(model)
    geoms, radii = planning.mjx.sphere_geoms(model)
    low, high = jnp.asarray(model.actuator_ctrlrange.T, jnp.float32)

    @jax.jit
    def plan(field, qpos, qvel, mean, key):
        keys = jax.random.split(key)
        noise = 0.4 * high * jax.random.normal(keys[0], (rollouts, *mean.shape))
        steady = 0.6 * high * jax.random.normal(keys[1], (rollouts, 1, mean.shape[1]))
        controls = jnp.clip(mean + (noise + steady).at[0].set(0), low, high)
        start = rest.replace(qpos=qpos, qvel=qvel)
        future = planning.mjx.rollout(robot, start, controls, geoms, HOLD)
        clearance = planning.sphere_clearance(field, future.centers_world, radii)
        to_goal = jnp.linalg.norm(future.centers_world[:, :, -1] - jnp.array(goal_world), axis=-1)
        too_near = jax.nn.relu(MARGIN - clearance)
        costs = to_goal.sum(1) + 200 * too_near.sum((1, 2)) + 1000 * (clearance < 0).sum((1, 2))
        weights = jax.nn.softmax(-(costs - costs.min()) / 0.3)
        return jnp.einsum("b,bhu->hu", weights, controls), costs[0]

    return plan


def drive(task, model, plan, field):
    """Drives the robot in MuJoCo; returns its distance to the goal and least clearance, m."""
    robot, (geoms, radii) = mujoco.MjData(model), planning.mjx.sphere_geoms(model)
    robot.qpos[:] = task.qpos
    mean, clearance = jnp.zeros((HORIZON, model.nu)), np.inf
    for key in jax.random.split(jax.random.key(1), task.steps):
        mean, _ = plan(field, jnp.array(robot.qpos), jnp.array(robot.qvel), mean, key)
        robot.ctrl[:], mean = mean[0], jnp.roll(mean, -1, axis=0)
        mujoco.mj_step(model, robot, HOLD)
        mujoco.mj_kinematics(model, robot)
        clearance = min(clearance, (exact_sdf(robot.geom_xpos[geoms]) - radii).min())
    return np.linalg.norm(robot.geom_xpos[geoms[-1]] - task.goal_world), clearance


if __name__ == "__main__":
    field = hio.snapshot(build_map())
    for task in (ROVER, ARM):
        model = load(task)
        distance, clearance = drive(task, model, make_planner(model, task.goal_world), field)
        print(f"{task.model}: {distance:.2f} m from its goal, least clearance {clearance:.3f} m")
