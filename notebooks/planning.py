# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# <!-- needs: jax_mppi -->
# # Planning on a map
#
# Four ways to plan on a map: along its gradient, around unseen space, with a sampling planner, and
# by checking thousands of configurations of an arm at once. This notebook needs
# [jax-mppi](https://pypi.org/project/jax-mppi/): in a clone, `pip install '.[plan]'`.

# %%
import contextlib
import io

import jax
import jax.numpy as jnp
import jax_mppi
import matplotlib.pyplot as plt
import mujoco
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # it prints that an optional package is missing
    from mujoco import mjx

import hiosdf_jax as hio
from hiosdf_jax import demo, planning

# %% [markdown]
# ## Two maps of a living room
# A depth camera is carried through it. `early` is the map after 6 clouds, `field` that after 14.
# Inner loops ask a map many times, so both are baked: a lattice around the robot, which
# interpolates.

# %%
stream = demo.ApartmentStream(frames=40)
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
state = hio.init(config, jax.random.key(0))
snapshots = []
for k in range(14):
    cloud, pose = stream[k]
    state = hio.update(state, cloud, pose)
    if k + 1 in (6, 14):
        snapshots.append(hio.snapshot(state))
early, field = snapshots
window = {"resolution": 0.05, "center": (3.9, 2.0, 1.1), "size": (4.0, 3.4, 2.2)}  # m
early_baked, baked = (hio.bake(each, **window) for each in snapshots)
print("a lattice of", baked.sdf.shape, "samples")


def exact_sdf(points_world):
    """Exact distances (...) m at points (..., 3) m: the maps do not know them."""
    points = np.asarray(points_world, float)
    return demo.signed_distance(stream.model, points.reshape(-1, 3))[0].reshape(points.shape[:-1])


x, y = np.meshgrid(np.linspace(1.9, 5.9, 120), np.linspace(0.3, 3.7, 102))
plane = np.stack([x, y, np.full_like(x, 1.2)], axis=-1).astype(np.float32)


def draw_map(axis, field, title):
    """Draws the slice at 1.2 m: unseen space is gray, true surfaces are black lines."""
    answer = hio.query(field, plane)
    values = np.where(answer.observed, answer.sdf, np.nan)
    image = axis.pcolormesh(x, y, values, cmap="Blues", vmin=0, vmax=1.5, rasterized=True)
    axis.contour(x, y, exact_sdf(plane), levels=[0], colors="black", linewidths=1)
    axis.set(title=title, xlabel="x [m]", ylabel="y [m]", aspect="equal", facecolor="0.75")
    axis.autoscale(False)
    return image


# %% [markdown]
# ## Along the gradient
# A ball with a radius of 15 cm has to pass a column. The straight line collides. The gradient of
# the distance pushes a path away from surfaces, but never to the other side of one. So several
# guesses are optimized at once, and the shortest clear path wins. By the map its clearance is less
# than it really is: the unseen voxels beside the column count as solid.

# %%
START, GOAL, RADIUS = jnp.array([2.8, 2.0, 1.2]), jnp.array([5.0, 1.9, 1.2]), 0.15  # m
guesses = planning.waves(jax.random.key(1), START, GOAL, count=16, waypoints=20, spread_m=0.4)
paths = planning.optimize_trajectory(baked, guesses, radius_m=RADIUS, margin_m=0.1, steps=200)
clear = np.asarray(paths.clearance > 0)
best = int(jnp.argmin(jnp.where(clear, paths.length, jnp.inf)))
print(f"{clear.sum()} of {len(clear)} paths are clear, the shortest has {paths.length[best]:.2f} m")
exact_cm = 100 * (exact_sdf(paths.waypoints_world[best]).min() - RADIUS)
print(f"its clearance: {100 * paths.clearance[best]:.0f} cm by the map, {exact_cm:.0f} cm exact")

figure, axis = plt.subplots(figsize=(7, 5), dpi=80, layout="constrained")
image = draw_map(axis, field, "optimized paths")
for k, path in enumerate(np.asarray(paths.waypoints_world)):
    axis.plot(*guesses[k, :, :2].T, ":", color="0.3", linewidth=0.8)
    axis.plot(*path[:, :2].T, color="#E69F00", linewidth=1, linestyle="-" if clear[k] else "--")
axis.plot([], [], ":", color="0.3", label="guess")
axis.plot([], [], color="#E69F00", label="optimized")
axis.plot(*paths.waypoints_world[best, :, :2].T, color="#D55E00", linewidth=3, label="shortest")
axis.plot(*np.stack([START, GOAL])[:, :2].T, "ko")
figure.legend(loc="outside lower center", ncols=3)
figure.colorbar(image, ax=axis, label="signed distance [m]", shrink=0.8)
plt.show()

# %% [markdown]
# ## Unseen space
# In space that no ray has reached, the network guesses. This is a line from seen into unseen space,
# in the early map: the guess is too large. `unknown="obstacle"` is never more than the distance to
# unseen space, and negative inside. It is the default of `hiosdf_jax.planning`. `lower` is a bound
# of the distance that each cloud recalibrates.

# %%
line = np.stack([np.linspace(2.5, 5.6, 200), np.full(200, 3.3), np.full(200, 1.2)], axis=-1)
line = line.astype(np.float32)
answer = hio.query(early, line)
figure, axis = plt.subplots(figsize=(8, 4), dpi=80, layout="constrained")
axis.fill_between(
    line[:, 0], -0.6, 1.4, where=~np.asarray(answer.observed), color="0.85", label="unseen"
)
axis.plot(line[:, 0], exact_sdf(line), color="black", label="exact")
axis.plot(line[:, 0], answer.sdf, "--", color="#D55E00", label='unknown="network"')
axis.plot(
    line[:, 0],
    hio.sdf(early, line, unknown="obstacle"),
    color="#0072B2",
    label='unknown="obstacle"',
)
axis.plot(line[:, 0], answer.lower, ":", color="#009E73", linewidth=2, label="lower")
axis.axhline(0, color="0.5", linewidth=0.8)
axis.set(
    title="along y = 3.3 m, z = 1.2 m", xlabel="x [m]", ylabel="distance [m]", ylim=(-0.6, 1.4)
)
figure.legend(loc="outside right upper")
plt.show()

# %% [markdown]
# ## A sampling planner
# MPPI draws controls around the last plan, follows each through the dynamics, and averages them by
# their costs. Its costs take the map as an *argument*. So one compiled controller serves the early
# map, the later one and every other: a new map never costs a new compilation. With the early map
# the ball keeps its distance from the goal, since unseen space begins beside it.

# %%
STEP_S, STEPS, MOST = 0.1, 60, 0.8  # s, steps, m/s


def drive(position, velocity):
    return position + STEP_S * jnp.clip(velocity, -MOST, MOST)


def running_cost(field, position, velocity):
    clearance = planning.sphere_clearance(field, position, RADIUS)
    return 200 * planning.collision_cost(clearance, 0.1) + 3 * jnp.linalg.norm(position - GOAL)


settings, first_plan = jax_mppi.create(
    nx=3,
    nu=3,
    noise_sigma=0.09 * jnp.eye(3),
    num_samples=256,
    horizon=25,
    u_min=-MOST * jnp.ones(3),
    u_max=MOST * jnp.ones(3),
    key=jax.random.key(0),
)
command = planning.mppi.controller(settings, drive, running_cost)


def simulate(field):
    """Drives to the goal, and returns the positions (STEPS + 1, 3) m."""
    position, plan, positions = START, first_plan, [START]
    for _ in range(STEPS):
        velocity, plan = command(plan, position, field)
        position = drive(position, velocity)
        positions.append(position)
    return np.stack(positions)


figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), dpi=72, sharey=True, layout="constrained")
for axis, name in zip(axes, ("early", "later"), strict=True):
    lattice, snapshot = {"early": (early_baked, early), "later": (baked, field)}[name]
    positions = simulate(lattice)
    image = draw_map(axis, snapshot, f"the ball drives, {name} map")
    axis.plot(*positions[:, :2].T, "o-", color="#D55E00", markersize=3)
    axis.plot(*np.stack([START, GOAL])[:, :2].T, "ko")
    least_cm = 100 * (exact_sdf(positions).min() - RADIUS)
    gap_cm = 100 * np.linalg.norm(positions[-1] - GOAL)
    print(f"{name} map: {gap_cm:.0f} cm from the goal, least exact clearance {least_cm:.0f} cm")
axes[1].set(ylabel=None)
figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.8)
plt.show()
print("compilations of the controller:", command._cache_size())

# %% [markdown]
# ## 4,096 configurations of an arm
# The arm of [`examples/arm.xml`](../examples/arm.xml) stands beside the column. MJX's kinematics
# under `vmap` place its balls, and one query checks the balls of all configurations.

# %%
spec = mujoco.MjSpec.from_file("../examples/arm.xml")
spec.body("turret").pos = (3.6, 1.5, 0.6)  # m
model = spec.compile()
spheres = planning.spheres_from_model(model, tolerance_m=0.01)
robot, rest = mjx.put_model(model), mjx.make_data(model)
limits = jnp.array([[-3.1, -1.6, -2.2, -1.5], [3.1, 0.8, 2.2, 1.5]])  # rad


def place(qpos):
    return planning.place_spheres(spheres, mjx.kinematics(robot, rest.replace(qpos=qpos)))


@jax.jit
def arm_clearance(field, configurations):
    """Clearances (N,) m of configurations (N, 4) rad, and the balls' centers (N, S, 3) m."""
    centers_world = jax.vmap(place)(configurations)
    clearance = planning.sphere_clearance(field, centers_world, spheres.radii)
    return clearance.min(axis=-1), centers_world


shares = jax.random.uniform(jax.random.key(2), (4096, 4))
configurations = limits[0] + shares * (limits[1] - limits[0])
clearance, centers_world = jax.tree.map(np.asarray, arm_clearance(baked, configurations))
exact = (exact_sdf(centers_world) - np.asarray(spheres.radii)).min(axis=-1)
free = clearance > 0
print(f"{free.sum():,} of {len(free):,} are free by the map, {(free & (exact < 0)).sum()} of them")
print(f"collide; {(~free & (exact > 0)).sum()} others are free too, near or in unseen space")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), dpi=70, layout="constrained")
image = draw_map(axes[0], field, "20 of them, from above")
for k in range(20):
    color, width = ("#0072B2", 2.5) if free[k] else ("#D55E00", 1.2)
    axes[0].plot(*centers_world[k, :, :2].T, "o-", color=color, linewidth=width, markersize=3)
axes[0].plot([], [], "o-", color="#0072B2", linewidth=2.5, label="free")
axes[0].plot([], [], "o-", color="#D55E00", linewidth=1.2, label="in collision or unseen")
axes[0].legend(fontsize=8, loc="upper left")
dots = axes[1].scatter(
    np.degrees(configurations[:, 0]),
    centers_world[:, -1, 2],
    c=clearance,
    s=6,
    cmap="PuOr",
    vmin=-0.3,
    vmax=0.3,
    rasterized=True,
)
axes[1].set(title="all of them", xlabel="turn of the base [°]", ylabel="height of the tip [m]")
figure.colorbar(dots, ax=axes[1], label="clearance [m]")
plt.show()

# %% [markdown]
# The gradient of the clearance by the joints moves configurations out of collision: all of them at
# once, for 30 steps.


# %%
@jax.jit
def push_out(field, configurations):
    def cost(configurations):
        return planning.collision_cost(arm_clearance(field, configurations)[0], 0.05).sum()

    def step(_, configurations):
        return jnp.clip(configurations - 0.2 * jax.grad(cost)(configurations), *limits)

    return jax.lax.fori_loop(0, 30, step, configurations)


pushed, _ = arm_clearance(baked, push_out(baked, configurations))
print(f"free before: {free.sum():,}, after: {int((pushed > 0).sum()):,}")

# %% [markdown]
# Continue with [the guide to planning](../docs/planning.md): swept clearances, safety filters, MJX
# rollouts, and mapping beside a controller.
