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
# A simulated depth camera moves through a furnished apartment. Each posed point cloud updates one
# differentiable signed distance field (SDF): positive in free space, zero on surfaces, negative
# behind them.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hiosdf_jax as hio
from hiosdf_jax import demo

# %% [markdown]
# ## A stream of posed clouds
# `cloud` is (N, 3) m in the sensor's frame, with NaN rows where there was no return. `pose` is the
# rigid (4, 4) transform from the sensor to the world.

# %%
stream = demo.ApartmentStream(frames=24)
cloud, pose = stream[0]
print(len(stream), "frames of", cloud.shape, "points, the first one from", pose[:3, 3], "m")

# %% [markdown]
# ## The map
# The whole map is one pytree. `Config.light` suits a CPU. On a GPU use `Config.default`.

# %%
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
state = hio.init(config, jax.random.key(0))
for cloud, pose in stream:
    state = hio.update(state, cloud, pose)
print("points used by the last update:", int(state.report.points_used))
print(f"mean |f - s| of its training samples: {100 * float(state.report.sdf_loss):.1f} cm")
print("flags so far:", repr(hio.Flag(state.report.flags)))

# %% [markdown]
# No flag: no cloud was refused, and no return in range lay outside the bounds.

# %% [markdown]
# ## Distances and gradients
# A planner holds a snapshot while mapping continues. The snapshot is an *argument* of the compiled
# function, so a newer map needs no new compilation.

# %%
field = hio.snapshot(state)


@jax.jit
def distance_and_gradient(field, points):
    return hio.sdf_and_grad(field, points)


points = jnp.array([[4.0, 3.5, 1.2], [1.0, 3.0, 1.0]])
distance, gradient = distance_and_gradient(field, points)
print("distance:", distance, "m")
print("gradient:", gradient)

# %% [markdown]
# A single point under `vmap` and a batch give the same answers.

# %%
many = jax.random.uniform(jax.random.key(1), (1000, 3)) * jnp.array([10.0, 8.0, 2.5])
one_by_one = jax.vmap(lambda point: hio.sdf(field, point))(many)
print("they agree to 1 um:", bool(jnp.abs(one_by_one - hio.sdf(field, many)).max() < 1e-6))

# %% [markdown]
# ## A slice
# The map at 1.2 m above the floor, beside the exact distances. Places that no ray has reached are
# gray.

# %%
x, y = np.meshgrid(np.linspace(0, 10, 150), np.linspace(0, 8, 120))
plane = np.stack([x, y, np.full_like(x, 1.2)], axis=-1).astype(np.float32)
answer = hio.query(field, plane)
observed = np.asarray(answer.observed)
exact = demo.signed_distance(stream.model, plane.reshape(-1, 3))[0].reshape(x.shape)
mapped = np.where(observed, answer.sdf, np.nan)

figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), dpi=90, sharey=True, layout="constrained")
for axis, values, title in ((axes[0], mapped, "map"), (axes[1], exact, "exact")):
    image = axis.pcolormesh(x, y, values, cmap="RdBu", vmin=-1, vmax=1, rasterized=True)
    axis.contour(x, y, values, levels=[0], colors="black", linewidths=1)
    axis.set(title=f"{title}, z = 1.2 m", xlabel="x [m]", aspect="equal", facecolor="0.75")
axes[0].set(ylabel="y [m]")
figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.85)
plt.show()

# %% [markdown]
# ## Unseen space
# `observed` is False where no ray has reached, and the distance there is a guess of the network. It
# is also False at a few points where rays contradict each other.
# `unknown="obstacle"` makes unseen space solid, which is what a planner wants.

# %%
above_the_view = jnp.array([2.9, 3.0, 2.1])
guess = hio.query(field, above_the_view)
print("observed:", bool(guess.observed))
safe = hio.sdf(field, above_the_view, unknown="obstacle")
ceiling = demo.signed_distance(stream.model, above_the_view[None])[0][0]
print(f"network: {float(guess.sdf):.2f} m, obstacle: {float(safe):.2f} m, exact: {ceiling:.2f} m")

# %% [markdown]
# ## Gradients point away from obstacles
# They have unit length almost everywhere, and push a trajectory out of collision. A short arrow is
# one that points mostly up or down.

# %%
step = 6
figure, axis = plt.subplots(figsize=(8, 6), dpi=80, layout="constrained")
image = axis.pcolormesh(x, y, mapped, cmap="Blues", vmin=0, vmax=1, rasterized=True)
shown = observed[::step, ::step] & (mapped[::step, ::step] > 0)
arrows = np.where(shown[..., None], np.asarray(answer.grad)[::step, ::step], np.nan)
axis.contour(x, y, mapped, levels=[0], colors="black", linewidths=1)
axis.quiver(x[::step, ::step], y[::step, ::step], arrows[..., 0], arrows[..., 1], scale=40)
axis.set(title="gradient, z = 1.2 m", xlabel="x [m]", ylabel="y [m]", aspect="equal")
axis.set(facecolor="0.75")
figure.colorbar(image, ax=axis, label="signed distance [m]", shrink=0.85)
plt.show()

# %% [markdown]
# ## How good is it?

# %%
inside = observed & (exact > 0)
error_cm = 100 * np.abs(np.asarray(answer.sdf) - exact)[inside]
print(f"mean error on this slice: {error_cm.mean():.1f} cm, median {np.median(error_cm):.1f} cm")

# %% [markdown]
# Continue with [planning on a map](../docs/planning.md).
