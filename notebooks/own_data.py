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
# # From your depth images to a map and a mesh
#
# If your recording has one of the [layouts that are known](../docs/streams.md), such as TUM RGB-D,
# ScanNet, KITTI or a ROS bag, `hiosdf map FOLDER` does all of this in one command, and
# `datasets.open_stream(FOLDER)` opens it here. This notebook is for everything else: it maps images
# and poses that you have as arrays or files of your own.

# %%
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import hiosdf_jax as hio
from hiosdf_jax import datasets, demo, exports, pictures, scoring

# %% [markdown]
# ## A recording
# Depth images of 16 bits in mm, the camera's intrinsics, and a pose for each image. Here they are
# simulated; replace this cell with your own files.

# %%
folder = Path(tempfile.mkdtemp())
stream = demo.ApartmentStream(frames=24)
height, width = stream.camera.height, stream.camera.width
for i, (cloud, _) in enumerate(stream):
    depth_mm = np.nan_to_num(1000 * cloud[:, 2]).reshape(height, width)
    Image.fromarray(np.rint(depth_mm).astype(np.uint16)).save(folder / f"{i:03}.png")
np.save(folder / "poses.npy", stream.poses_world_sensor)
focal = width / 2  # pixels: the field of view is 90 degrees
intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
print(len(list(folder.glob("*.png"))), "images of", width, "x", height)

# %% [markdown]
# ## Clouds and poses
# A map takes clouds in the sensor's frame, in m, and `T_world_sensor`. A camera looks along z, with
# x to the right and y down. `FrameStream` reads a frame when it is asked for.

# %%
poses_world_sensor = np.load(folder / "poses.npy")


def read(index):
    with Image.open(folder / f"{index:03}.png") as image:
        depth = np.asarray(image) / 1000.0  # m; 0 is not a return
    cloud = np.asarray(datasets.depth_to_cloud(depth, intrinsics))
    return cloud, poses_world_sensor[index]


frames = datasets.FrameStream(folder, len(poses_world_sensor), read)
cloud, pose = frames[0]
print("cloud", cloud.shape, "pose", pose.shape)

# %% [markdown]
# ## Look at it first
# Most maps that look wrong have wrong poses. Put a few clouds into the world frame and look from
# above: the walls of different frames must coincide. If they fan out, the poses may be
# `T_sensor_world`: invert them. If rooms are mirrored or stand on their side, the camera's axes are
# others. If everything is too large or small, a length is not in m.

# %%
figure, axis = plt.subplots(figsize=(6.5, 5), dpi=80, layout="constrained")
for k, index in enumerate((0, 1, 2, 3)):
    cloud, pose = frames[index]
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    world = cloud @ pose[:3, :3].T + pose[:3, 3]
    walls = world[(world[:, 2] > 0.5) & (world[:, 2] < 2.0)]  # m above the floor
    color = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")[k]  # suits color-blind eyes
    axis.plot(*walls[::3, :2].T, ".", markersize=1.5, color=color, rasterized=True)
    axis.plot(*pose[:2, 3], "o", color=color, label=f"frame {index}")
axis.set(
    title="four clouds in the world frame, and their cameras",
    xlabel="x [m]",
    ylabel="y [m]",
    aspect="equal",
)
figure.legend(loc="outside lower center", ncols=4, fontsize=8)
plt.show()

# %% [markdown]
# ## The map
# `bounds` is the box to map, in m. `datasets.find_bounds(frames)` finds it if you do not know it.
# Every eighth frame is held out, to score the map.

# %%
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=6.0)
state = hio.init(config, jax.random.key(0))
held_out_world = []
for index in range(len(frames)):
    cloud, pose = frames[index]
    if index % 8 == 7:
        held_out_world.append(cloud @ pose[:3, :3].T + pose[:3, 3])
    else:
        state = hio.update(state, cloud, pose)
field = hio.snapshot(state)
print(int(state.updates), "updates; flags:", repr(hio.Flag(state.report.flags)))

# %% [markdown]
# Flags name what was wrong in any update: `BAD_POSE` is a matrix that is not rigid, and
# `POINTS_OUTSIDE` means that returns lay beyond the bounds.
#
# ## Is it right?
# Held-out returns lie on surfaces, so the map should say 0 there, as far as it has seen the place.

# %%
returns = np.concatenate(held_out_world).astype(np.float32)
returns = returns[np.isfinite(returns).all(axis=1)]
is_observed = jax.jit(lambda field, points: hio.query(field, points).observed)
returns = returns[np.asarray(is_observed(field, returns))]
scores = scoring.held_out_surface(lambda points: hio.sdf(field, points), returns)
print(f"median distance of held-out returns: {scores['median_cm']:.1f} cm")
print(f"90 % of them are within {scores['p90_cm']:.1f} cm")

# %% [markdown]
# ## The mesh
# `extract_mesh` has surfaces where rays ended. It closes gaps narrower than 0.6 voxels.

# %%
mesh = hio.extract_mesh(field, 0.05)
pictures.save_shaded(folder / "mesh.png", mesh, size=(800, 600))
figure, axis = plt.subplots(figsize=(8, 6), dpi=80, layout="constrained")
axis.imshow(plt.imread(folder / "mesh.png"))
axis.set_axis_off()
plt.show()

# %% [markdown]
# ## Keep it
# `hio.save` keeps the whole map: load it with `hio.load`, and update it further.
# [Other programs](../docs/exports.md) read the mesh, the distances on a lattice, or a costmap.

# %%
hio.save(folder / "map.npz", state)
exports.export_map(folder / "mesh.ply", field)
exports.export_map(folder / "field.vti", field, resolution=0.2)  # ParaView
exports.export_map(folder / "floor.yaml", field, floor_m=0.0, height_m=1.2, radius_m=0.25)
print(sorted(path.name for path in folder.iterdir() if path.suffix != ".png"))

# %% [markdown]
# The costmap says where the middle of a robot of 25 cm radius may be: white is free, black is
# occupied, gray is unknown.

# %%
figure, axis = plt.subplots(figsize=(6.5, 5), dpi=80, layout="constrained")
(x0, y0, _), (x1, y1, _) = config.bounds
with Image.open(folder / "floor.pgm") as image:
    axis.imshow(image, cmap="gray", vmin=0, vmax=254, extent=(x0, x1, y0, y1))
axis.set(title="costmap", xlabel="x [m]", ylabel="y [m]")
plt.show()

# %% [markdown]
# [In a browser](../docs/view.md) you can walk around in the map: `hio.view(field)`, or
# `hiosdf view map.npz`. Continue with [planning on a map](../docs/planning.md).
