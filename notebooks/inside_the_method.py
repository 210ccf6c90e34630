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
# # Inside the method
#
# A map has two parts. A coarse grid remembers what the rays have met. A small network learns the
# distances from samples of the grid and of the newest cloud. This notebook looks at each part, and
# at what it contributes to the answer. [Architecture](../docs/architecture.md) describes all
# stages, with the sections of the [paper](https://arxiv.org/abs/2310.09463).

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import hiosdf_jax as hio
from hiosdf_jax import demo

# Private functions, which can change with any version: a program has no use for them.
from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.samples.from_cloud import sample_cloud
from hiosdf_jax._src.samples.from_grid import sample_grid

# %% [markdown]
# ## A map, and the losses of its updates

# %%
stream = demo.ApartmentStream(frames=40)
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
state = hio.init(config, jax.random.key(0))
losses = []
for k in range(14):
    cloud, pose = stream[k]
    state = hio.update(state, cloud, pose)
    losses.append((100 * float(state.report.sdf_loss), float(state.report.eikonal_loss)))
print(int(state.updates), "updates of", config.grid_shape, "voxels of", config.voxel_size, "m")

# %% [markdown]
# ## The grid
# A voxel is 10 cm wide. It counts the rays that ended in it and those that went through, and keeps
# the mean and the principal axes of the returns: a *patch* of surface that is finer than the voxel.
# The left picture has the voxels of one layer around a column, and their patches as lines. A
# distance transform then finds each voxel's nearest patch: on the right are the distances of the
# voxels' centers.

# %%
layer = round(1.2 / config.voxel_size) - config.corner_index[2]
evidence, derived = (
    jax.tree.map(lambda array: np.asarray(array[:, :, layer], np.float32), part)
    for part in (state.grid.evidence, state.grid.derived)
)
observed = derived.frontier_steps > 0
has_patch = (derived.nearest == 0).all(axis=-1)  # its nearest patch is its own
edges = [
    config.voxel_size * (first + np.arange(count + 1))
    for first, count in zip(config.corner_index[:2], config.grid_shape[:2], strict=True)
]

index = np.argwhere(has_patch)
centers = config.voxel_size * (index + np.array(config.corner_index[:2]) + 0.5)
centers = centers + config.voxel_size * evidence.mean[has_patch][:, :2]
lines = []
for axis_of_patch in (0, 1):  # the two long ones; a patch reaches 1.6 standard deviations
    half = 1.6 * config.voxel_size * evidence.axes[has_patch][:, axis_of_patch, :2]
    lines += list(np.stack([centers - half, centers + half], axis=1))

figure, axes = plt.subplots(1, 2, figsize=(11, 5), dpi=80, sharey=True, layout="constrained")
kinds, colors = np.where(has_patch, 2, observed), ["#BFBFBF", "#DCEEF9", "#FBE3B5"]
axes[0].pcolormesh(*edges, kinds.T, cmap=ListedColormap(colors), vmin=0, vmax=2, rasterized=True)
axes[0].add_collection(LineCollection(lines, colors="black", linewidths=1.5))
names = ("unseen", "free", "with a patch")
patches = [Patch(color=color, label=name) for color, name in zip(colors, names, strict=True)]
axes[0].legend(handles=patches, loc="upper left", fontsize=8)
distances = np.where(observed | has_patch, derived.sdf, np.nan)
image = axes[1].pcolormesh(*edges, distances.T, cmap="RdBu", vmin=-1, vmax=1, rasterized=True)
for axis, title in zip(axes, ("voxels and patches", "distances of the voxels"), strict=True):
    axis.set(title=f"{title}, z = 1.2 to 1.3 m", xlabel="x [m]", aspect="equal", facecolor="0.75")
    axis.set(xlim=(3.2, 6.2), ylim=(0.4, 3.2))
axes[0].set(ylabel="y [m]")
figure.colorbar(image, ax=axes[1], label="signed distance [m]", shrink=0.8)
plt.show()
print("hits in the voxels with a patch, median:", int(np.median(evidence.hits[has_patch])))

# %% [markdown]
# ## The samples
# Each update trains on points with distances from two sources.
#
# - *The grid*: voxels of the whole known map are drawn at random, so that the network does not
#   forget what the sensor does not see now.
# - *The newest cloud*: points on its rays. Their distance is that to the nearest point of the
#   cloud, and the sign changes at the end of the ray. Those within 20 cm of the cloud are kept.

# %%
cloud, pose = (jnp.asarray(part, jnp.float32) for part in stream[3])


@jax.jit
def draw_samples(grid, cloud, pose):
    placed = place_cloud(config, cloud, jnp.isfinite(cloud).all(axis=-1), pose, None)
    return (
        sample_grid(config, grid, jax.random.key(0)),
        sample_cloud(config, placed, jax.random.key(1)),
    )


from_grid, from_cloud = jax.tree.map(np.asarray, draw_samples(state.grid, cloud, pose))
in_layer = (np.abs(from_grid.points_world[:, 2] - 1.2) < 0.1) & (from_grid.weight > 0)

figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), dpi=80, layout="constrained")
axes[0].set(title="samples of the grid, z = 1.1 to 1.3 m")
axes[1].set(title="samples of one cloud, seen from above")
for axis, samples, chosen in (
    (axes[0], from_grid, in_layer),
    (axes[1], from_cloud, from_cloud.weight > 0),
):
    limit = 1.0 if axis is axes[0] else 0.2
    dots = axis.scatter(
        *samples.points_world[chosen, :2].T,
        c=samples.sdf[chosen],
        s=6,
        cmap="RdBu",
        vmin=-limit,
        vmax=limit,
        rasterized=True,
    )
    axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", facecolor="0.6")
    figure.colorbar(dots, ax=axis, label="signed distance [m]", shrink=0.7)
axes[1].plot(*np.asarray(pose)[:2, 3], "k^", markersize=9, label="camera")
axes[1].legend(fontsize=8)
plt.show()
print("of the grid:", int(from_grid.weight.sum()), "of the cloud:", int(from_cloud.weight.sum()))

# %% [markdown]
# ## The training
# A few gradient steps per update lower the mean |f - s| of the samples (the paper's equation 4) and
# the mean deviation of the gradient's norm from 1 (equation 5). The network never starts over:
# an update continues with the weights of the last one. The losses rise after the fifth update, with
# which the warm-up of more epochs ends, and while the kitchen comes into view, which is new to the
# network. Then they fall again.

# %%
sdf_cm, eikonal = np.array(losses).T
updates = np.arange(1, len(losses) + 1)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), dpi=80, layout="constrained")
for axis, values, label in ((axes[0], sdf_cm, "mean |f - s| [cm]"), (axes[1], eikonal, None)):
    axis.plot(updates, values, "o-", color="#0072B2")
    axis.set(xlabel="update", ylabel=label or "mean | |gradient| - 1 |  [-]", ylim=(0, None))
axes[0].set(title="distance loss")
axes[1].set(title="Eikonal loss")
plt.show()

# %% [markdown]
# ## What each contributes
# `Config.grid_share` says how the two parts answer together: 1 is the grid alone where it has an
# answer, 0 is the network alone, as in the paper, and 0.9 is the default. The errors are those of
# free space that a ray has reached.

# %%
field = hio.snapshot(state)
x, y = np.meshgrid(np.linspace(0, 10, 200), np.linspace(0, 4.4, 88))
plane = np.stack([x, y, np.full_like(x, 1.2)], axis=-1).astype(np.float32)
exact = demo.signed_distance(stream.model, plane.reshape(-1, 3))[0].reshape(x.shape)
is_observed = jax.jit(lambda field, points: hio.query(field, points).observed)
scored = np.asarray(is_observed(field, plane)) & (exact > 0)

figure, axes = plt.subplots(
    3, 1, figsize=(8, 10), dpi=80, sharex=True, sharey=True, layout="constrained"
)
shares = {"grid alone": 1.0, "network alone": 0.0, "both blended": config.grid_share}
for axis, (name, share) in zip(axes, shares.items(), strict=True):
    part = field.replace(config=dataclasses.replace(config, grid_share=share))
    error_cm = 100 * (np.asarray(hio.sdf(part, plane)) - exact)
    print(f"{name}: {np.abs(error_cm[scored]).mean():.2f} cm")
    shown = np.where(scored, error_cm, np.nan)
    image = axis.pcolormesh(x, y, shown, cmap="PuOr", vmin=-10, vmax=10, rasterized=True)
    axis.contour(x, y, exact, levels=[0], colors="black", linewidths=1)
    axis.set(title=f"{name}, z = 1.2 m", ylabel="y [m]", aspect="equal", facecolor="0.75")
axes[-1].set(xlabel="x [m]")
figure.colorbar(image, ax=axes, label="error [cm]", shrink=0.6, extend="both")
plt.show()

# %% [markdown]
# The grid is accurate near surfaces that were seen well. The network answers everywhere, but is
# still wrong in the kitchen, on which few updates have trained it. The blend is the grid's answer
# with a tenth of the network's correction. It fades to the network beyond the grid's horizon and in
# unseen space. Around the column all three are too far: no cloud has shown its other side yet.
# [The benchmarks](../benchmarks/README.md#accuracy) leave out the other parts in turn: local
# samples, carving, the Eikonal loss.
#
# Continue with [planning on a map](planning.ipynb).
