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
# # A thousand maps at once
#
# A map is a pytree and `update` is a pure function. `jax.lax.scan` runs it over the scans of a
# room, `jax.vmap` over many rooms, and arrays with a sharding divide the rooms among devices. Such
# a fleet answers questions about maps in general, trains a policy in many worlds, or keeps a map
# for each particle of a filter.
#
# Here 1,024 random rooms are mapped from four scans each. The question: how large is the error
# after each scan, and how much does it differ between rooms?

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

jax.config.update("jax_num_cpu_devices", 2)  # two virtual devices; GPUs need no such line

import hiosdf_jax as hio

MAPS, SCANS, RAYS = 1024, 4, 128

# %% [markdown]
# ## A small map
# On two CPU cores the maps have to be small: 1,024 rooms of at most 3 x 3 x 1.5 m with voxels of
# 25 cm, and a network of 16 units. A GPU has room for more: 1,024 maps with 32,000 voxels each take
# [43 ms per update of all](../benchmarks/README.md#speed) on an H100.

# %%
config = hio.Config.light(
    ((-1.5, -1.5, -0.75), (1.5, 1.5, 0.75)),
    voxel_size=0.25,
    max_points=RAYS,
    max_range=4.0,
    distance_horizon=1.25,
    near_samples=50,
    far_samples=50,
    local_points=4,
    local_ray_samples=5,
    hidden_width=16,
    hidden_layers=1,
    batches=1,
    epochs=2,
)
print("voxels of a map:", config.grid_shape)

# %% [markdown]
# ## A random room
# A room is a box with a round pillar. A sensor scans it from a place in each of its four corners.
# Everything is a function of one room, and JAX functions all the way, so that it can be mapped over
# rooms.


# %%
def draw_room(key):
    """Half the room's edges (3,) m, and the pillar's (x, y, radius) m."""
    keys = jax.random.split(key)
    half = jax.random.uniform(keys[0], (3,), minval=0.75, maxval=0.98)
    pillar = jax.random.uniform(keys[1], (3,), minval=-1.0, maxval=1.0)
    scale, least = jnp.array([0.3, 0.3, 0.1]), jnp.array([0.0, 0.0, 0.2])
    return half * jnp.array([1.5, 1.5, 0.75]), pillar * scale + least


def exact_sdf(room, points_world):
    """Exact distances (...) m at points (..., 3) m in free space."""
    half, pillar = room
    walls = (half - jnp.abs(points_world)).min(axis=-1)
    return jnp.minimum(
        walls, jnp.linalg.norm(points_world[..., :2] - pillar[:2], axis=-1) - pillar[2]
    )


def scan_room(room, key, corner):
    """A scan (RAYS, 3) m in the sensor's frame, and its pose (4, 4)."""
    half, pillar = room
    keys = jax.random.split(key)
    position = half * (corner + 0.15 * jax.random.uniform(keys[0], (3,), minval=-1.0))
    rays = jax.random.normal(keys[1], (RAYS, 3))
    rays /= jnp.linalg.norm(rays, axis=-1, keepdims=True)
    to_walls = ((half * jnp.sign(rays) - position) / rays).min(axis=-1)
    # The nearer root of |position + t ray - pillar| = radius, in x and y.
    offset = position[:2] - pillar[:2]
    a, b = (rays[:, :2] ** 2).sum(axis=-1), rays[:, :2] @ offset
    inside = b**2 - a * (offset @ offset - pillar[2] ** 2)
    to_pillar = (-b - jnp.sqrt(jnp.maximum(inside, 0))) / a
    hits = (inside > 0) & (to_pillar > 0)
    ranges = jnp.where(hits, jnp.minimum(to_pillar, to_walls), to_walls)
    return ranges[:, None] * rays, jnp.eye(4).at[:3, 3].set(position)


# %% [markdown]
# ## One room: `scan`
# The carry is the map. After each scan, the map is compared with the exact distances at random
# points that it has observed.

# %%
CORNERS = 0.6 * jnp.array([[1.0, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]])


def map_room(key):
    """The map of a random room, the room, and the mean error after each scan, (SCANS,) cm."""
    keys = jax.random.split(key, 3 + SCANS)
    room = draw_room(keys[0])
    share = jax.random.uniform(keys[1], (256, 3), minval=-0.95, maxval=0.95)
    points = share * room[0]
    exact = exact_sdf(room, points)

    def step(state, frame):
        state = hio.update(state, *scan_room(room, *frame))
        answer = hio.query(state, points)
        scored = answer.observed & (exact > 0)
        error = jnp.where(scored, jnp.abs(answer.sdf - exact), 0).sum() / scored.sum()
        return state, 100 * error

    state, errors_cm = jax.lax.scan(step, hio.init(config, keys[2]), (keys[3:], CORNERS))
    return state, room, errors_cm


# %% [markdown]
# ## A thousand rooms: `vmap`, on all devices
# The keys of the rooms are divided among the devices, and everything that is computed from them
# stays where it is. There is no other change: `jax.jit` sees the sharding of its arguments.

# %%
devices = jax.devices()
mesh = jax.make_mesh((len(devices),), ("maps",), axis_types=(AxisType.Auto,))
keys = jax.device_put(
    jax.random.split(jax.random.key(0), MAPS), NamedSharding(mesh, PartitionSpec("maps"))
)
states, rooms, errors_cm = jax.block_until_ready(jax.jit(jax.vmap(map_room))(keys))
print(f"{MAPS:,} maps on {len(devices)} devices:", states.grid.derived.sdf.sharding.spec)
shard = states.grid.derived.sdf.addressable_shards[0]
print("distances of the voxels on the first device:", shard.data.shape)
size = sum(leaf.nbytes for leaf in jax.tree.leaves(states)) / MAPS
print(f"memory of a map: {size / 1e3:.0f} kB; updates of each: {int(states.updates.min())}")

# %% [markdown]
# ## The error after each scan
# The median over rooms, and the range that holds 80 % of them.

# %%
low, median, high = np.percentile(errors_cm, (10, 50, 90), axis=0)
figure, axis = plt.subplots(figsize=(6.5, 4), dpi=80, layout="constrained")
scans = np.arange(1, SCANS + 1)
axis.fill_between(scans, low, high, color="#56B4E9", alpha=0.5, label="80 % of the rooms")
axis.plot(scans, median, "o-", color="#0072B2", label="median room")
axis.set(title=f"{MAPS:,} rooms", xlabel="scans", ylabel="mean error of a map [cm]", ylim=(0, None))
axis.set_xticks(scans)
axis.legend()
plt.show()
print(f"median error after {SCANS} scans: {median[-1]:.1f} cm")

# %% [markdown]
# ## Look at some
# A query of a stack of maps is a `vmap`, too. These are slices of the four best and the four worst
# maps, by their mean error, at the height of the sensors. The orange lines are the exact walls and
# pillars. Gray is unseen.

# %%
order = np.argsort(np.asarray(errors_cm[:, -1]))
chosen = np.concatenate([order[:4], order[-4:]])
take = jax.jit(lambda stacks: jax.tree.map(lambda leaf: leaf[chosen], stacks))
few, few_rooms = take((states, rooms))
ticks = np.linspace(-1.5, 1.5, 90)
x, y = np.meshgrid(ticks, ticks)
plane = jnp.asarray(np.stack([x, y, np.zeros_like(x)], axis=-1), jnp.float32)


@jax.jit
@jax.vmap
def slice_of(state, room):
    """Mapped and exact distances on the plane, m; NaN in unseen space."""
    answer = hio.query(state, plane)
    return jnp.where(answer.observed, answer.sdf, jnp.nan), exact_sdf(room, plane)


mapped, exact = slice_of(few, few_rooms)

figure, axes = plt.subplots(
    2, 4, figsize=(10, 5.4), dpi=80, sharex=True, sharey=True, layout="constrained"
)
for k, axis in enumerate(axes.ravel()):
    image = axis.pcolormesh(x, y, mapped[k], cmap="RdBu", vmin=-0.5, vmax=0.5, rasterized=True)
    axis.contour(x, y, exact[k], levels=[0], colors="#E69F00", linewidths=2)
    axis.set(title=f"{errors_cm[chosen[k], -1]:.1f} cm", aspect="equal", facecolor="0.75")
for axis in axes[:, 0]:
    axis.set(ylabel="y [m]")
for axis in axes[1]:
    axis.set(xlabel="x [m]")
figure.colorbar(image, ax=axes, label="signed distance [m]", shrink=0.8)
plt.show()

# %% [markdown]
# ## Next
# [Performance](../docs/performance.md#fleets) has the times of a fleet on a GPU.
# `jax.vmap(jax.grad(...))` works in the same way: [gradients through an
# update](../docs/gradients.md).
