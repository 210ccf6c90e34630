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
# # From a camera to a signed distance field
#
# A simulated depth camera is carried through a furnished apartment. Each posed point cloud updates
# one differentiable signed distance field (SDF): positive in free space, zero on surfaces.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hiosdf_jax as hio
from hiosdf_jax import demo

# %% [markdown]
# ## A stream of posed clouds
# `cloud` is (N, 3) in the sensor's frame, metres, with NaN rows where there was no return; `pose`
# is the rigid (4, 4) transform from the sensor to the world.

# %%
stream = demo.ApartmentStream(frames=40)
cloud, pose = stream[0]
print(len(stream), "frames of", cloud.shape, "sensor at", pose[:3, 3], "m")

# %% [markdown]
# ## The map
# The whole map is one pytree. `Config.light` suits a CPU; on a GPU take `Config.default`.

# %%
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
state = hio.init(config, jax.random.key(0))
for frame in range(len(stream)):
    cloud, pose = stream[frame]
    state = hio.update(state, cloud, pose)
print("points used by the last update:", int(state.report.points_used))
print(f"mean |f - s| of its samples: {100 * float(state.report.sdf_loss):.1f} cm")
print("flags:", repr(hio.Flag(int(state.report.flags))))

# %% [markdown]
# ## Distances and gradients
# A snapshot is what a planner holds while the map goes on. It is an *argument* of the compiled
# function, so that a newer map needs no new compilation.

# %%
field = hio.snapshot(state)


@jax.jit
def clearance(field, points):
    return hio.sdf_and_grad(field, points)


points = jnp.array([[4.0, 3.5, 1.2], [1.0, 3.0, 1.0]])
distance, gradient = clearance(field, points)
print("distance [m]:", distance)
print("gradient:", gradient)
print("seen:", hio.query(field, points).observed)

# %% [markdown]
# One point or a thousand, `vmap` or a batch: the same answers.

# %%
many = jax.random.uniform(jax.random.key(1), (1000, 3)) * jnp.array([10.0, 8.0, 2.5])
one_by_one = jax.vmap(lambda point: hio.sdf(field, point))(many)
print("largest difference [m]:", float(jnp.abs(one_by_one - hio.sdf(field, many)).max()))

# %% [markdown]
# ## A slice
# At 1.2 m above the floor, beside the exact distance; unseen places are left out.

# %%
x, y = np.meshgrid(np.linspace(0, 10, 150), np.linspace(0, 8, 120))
plane = np.stack([x, y, np.full_like(x, 1.2)], axis=-1).astype(np.float32)
answer = hio.query(field, plane)
exact = demo.signed_distance(stream.model, plane.reshape(-1, 3))[0].reshape(x.shape)
mapped = np.where(answer.observed, answer.sdf, np.nan)

figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True, layout="constrained")
for axis, values, title in ((axes[0], mapped, "map"), (axes[1], exact, "exact")):
    image = axis.pcolormesh(x, y, values, cmap="RdBu", vmin=-1, vmax=1)
    axis.contour(x, y, values, levels=[0], colors="black", linewidths=1)
    axis.set(title=f"{title}, z = 1.2 m", xlabel="x [m]", ylabel="y [m]", aspect="equal")
figure.colorbar(image, ax=axes, label="signed distance [m]")
plt.show()

# %% [markdown]
# ## Gradients point away from obstacles
# They have unit length almost everywhere, and are what pushes a trajectory out of collision.

# %%
step = 6
figure, axis = plt.subplots(figsize=(8, 6), layout="constrained")
axis.pcolormesh(x, y, mapped, cmap="Blues", vmin=0, vmax=1)
seen = np.asarray(answer.observed)[::step, ::step]
arrows = np.where(seen[..., None], np.asarray(answer.grad)[::step, ::step], np.nan)
axis.quiver(x[::step, ::step], y[::step, ::step], arrows[..., 0], arrows[..., 1], scale=40)
axis.set(title="gradient of the SDF, z = 1.2 m", xlabel="x [m]", ylabel="y [m]", aspect="equal")
plt.show()

# %% [markdown]
# ## How good is it?

# %%
inside = np.asarray(answer.observed) & (exact > 0)
error_cm = 100 * np.abs(np.asarray(answer.sdf) - exact)[inside]
print(f"mean error on this slice: {error_cm.mean():.1f} cm, median {np.median(error_cm):.1f} cm")
