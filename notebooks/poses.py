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
# # Drift, a lost robot, and two maps
#
# A robot rarely knows its pose exactly. Here the map itself corrects odometry that drifts. Then a
# second robot, which has a frame of its own, is found in that map, and the two maps become one.

# %%
import itertools

import jax
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax import demo

stream = demo.ApartmentStream(frames=240)  # 10 Hz
config = hio.Config.light(demo.BOUNDS_WORLD, max_range=stream.max_range)
clouds, exact = zip(*[stream[i] for i in range(0, 96, 4)], strict=True)

# %% [markdown]
# ## Odometry that drifts
# Its steps are 2 % too long, and it turns by 0.5 degrees per meter.


# %%
def drifting(poses):
    """Poses (4, 4) T_odom_sensor of a robot whose odometry drifts."""
    result = [poses[0]]
    for before, after in itertools.pairwise(poses):
        step = np.linalg.inv(before) @ after
        turn = 0.5 * np.linalg.norm(step[:3, 3])
        step[:3, 3] *= 1.02
        pose = result[-1] @ step
        pose[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix() @ pose[:3, :3]
        result.append(pose.astype(np.float32))
    return result


odometry = drifting(exact)


def distance_cm(first, second):
    """Distance between the positions of two poses."""
    return 100 * np.linalg.norm(np.asarray(first)[:3, 3] - np.asarray(second)[:3, 3])


way = sum(distance_cm(a, b) for a, b in itertools.pairwise(exact))
print(f"after {way / 100:.0f} m the odometry is {distance_cm(odometry[-1], exact[-1]):.0f} cm off")

# %% [markdown]
# ## With and without the map's help
# `update` takes each pose as given. `track` refines it first: `predict_pose` adds the motion of the
# odometry to the last refined pose, and the cloud is registered in the map near there.

# %%
unrefined = hio.init(config, jax.random.key(0))
for cloud, pose in zip(clouds, odometry, strict=True):
    unrefined = hio.update(unrefined, cloud, pose)

state, found = hio.track(hio.init(config, jax.random.key(0)), clouds[0], odometry[0])
tracked, reference = [found.pose], 0  # the last registered frame
for i in range(1, len(clouds)):
    predicted = hio.predict_pose(tracked[reference], odometry[reference], odometry[i])
    state, found = hio.track(state, clouds[i], predicted)
    tracked.append(found.pose)
    if found.converged:
        reference = i
print(f"the tracked pose is {distance_cm(tracked[-1], exact[-1]):.1f} cm off")

# %% [markdown]
# ## Both maps
# A slice 1.2 m above the floor. Black lines are the walls of the map, red ones the true walls.

# %%
x, y = np.meshgrid(np.linspace(0, 10, 150), np.linspace(0, 8, 120))
plane = np.stack([x, y, np.full_like(x, 1.2)], axis=-1).astype(np.float32)
true_sdf = demo.signed_distance(stream.model, plane.reshape(-1, 3))[0].reshape(x.shape)


def slice_of(state):
    """Signed distances on the plane, m; NaN in unseen space."""
    answer = hio.query(state, plane)
    return np.where(answer.observed, answer.sdf, np.nan)


def error_cm(values):
    """Mean error in free space."""
    return 100 * np.nanmean(np.abs(values - true_sdf)[true_sdf > 0])


def draw(axis, values, title):
    """Draws a slice and the true walls."""
    axis.pcolormesh(x, y, values, cmap="Blues", vmin=0, vmax=1.5, rasterized=True)
    axis.contour(x, y, true_sdf, levels=[0], colors="red", linewidths=0.8)
    axis.contour(x, y, values, levels=[0], colors="black", linewidths=1.2)
    axis.set(title=title, xlabel="x [m]", aspect="equal", facecolor="0.8", xlim=(0, 10))


drifted, corrected = slice_of(unrefined), slice_of(state)
figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), dpi=90, sharey=True, layout="constrained")
for axis, values, poses, name in (
    (axes[0], drifted, odometry, "odometry"),
    (axes[1], corrected, tracked, "tracked"),
):
    draw(axis, values, f"{name}: mean error {error_cm(values):.1f} cm")
    axis.plot(*np.stack(exact)[:, :2, 3].T, color="red", label="true path")
    axis.plot(*np.stack(poses)[:, :2, 3].T, color="black", linestyle="--", label="path of the map")
axes[0].set(ylabel="y [m]")
axes[0].legend(loc="upper left", fontsize=8)
plt.show()
print(f"error with tracking: {error_cm(corrected):.1f} cm")

# %% [markdown]
# ## A robot that is lost
# A second robot starts in the same apartment. Its map begins in a frame of its own: it knows only
# where it has moved since, and, from an accelerometer, where up is.

# %%
world_b = np.eye(4)  # T_world_b, which nobody knows
world_b[:3, :3] = Rotation.from_euler("z", 190, degrees=True).as_matrix()
world_b[:3, 3] = [9.6, 9.0, 0.0]
frames_b = [stream[i] for i in range(77, 179, 9)]
poses_b = [(np.linalg.inv(world_b) @ pose).astype(np.float32) for _, pose in frames_b]

state_b = hio.init(config, jax.random.key(1))
for (cloud, _), pose in zip(frames_b, poses_b, strict=True):
    state_b = hio.update(state_b, cloud, pose)

# %% [markdown]
# `relocalize` looks for its first cloud in the map of the first robot. It needs no prior: it tries
# thousands of poses in free space and refines the best of them. `score` is the share of returns
# that fit, and `other_score` is that of the best pose elsewhere.

# %%
cloud, _ = frames_b[0]
up_sensor = poses_b[0][:3, :3].T @ np.array([0.0, 0.0, 1.0])
place = hio.relocalize(hio.snapshot(state), cloud, jax.random.key(2), 4096, up_sensor=up_sensor)
print(f"score {float(place.score):.2f}, elsewhere {float(place.other_score):.2f}")
pose_a_b = np.asarray(place.best.pose) @ np.linalg.inv(poses_b[0])
print(f"the frame of the second robot is {distance_cm(pose_a_b, world_b):.1f} cm off")

# %% [markdown]
# ## Two maps become one
# `merge` adds the surfaces and the counts of rays of the second map, without its clouds.

# %%
both = hio.merge(state, state_b, pose_a_b)

figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), dpi=90, sharey=True, layout="constrained")
for axis, values, title in (
    (axes[0], corrected, "the first map"),
    (axes[1], slice_of(both), "both, merged"),
):
    draw(axis, values, title)
returns = np.asarray(cloud)[np.isfinite(cloud).all(axis=-1)][::50]
returns = returns @ np.asarray(place.best.pose)[:3, :3].T + np.asarray(place.best.pose)[:3, 3]
axes[0].scatter(*returns[:, :2].T, s=2, color="green", label="the cloud of the lost robot")
axes[0].plot(*np.asarray(place.best.pose)[:2, 3], "g*", markersize=10, label="where it is found")
axes[0].legend(loc="upper left", fontsize=8)
axes[0].set(ylabel="y [m]")
plt.show()
print(f"known: {np.isfinite(corrected).mean():.0%} of the slice before,", end=" ")
print(f"{np.isfinite(slice_of(both)).mean():.0%} after")
print(f"error of the merged map: {error_cm(slice_of(both)):.1f} cm")
