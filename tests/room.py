"""A box-shaped room, a sensor that looks around in it, and maps that are small enough for tests."""

import jax
import jax.numpy as jnp
import numpy as np

import hiosdf_jax as hio

BOUNDS = ((-1.2, -1.0, -0.8), (1.2, 1.0, 0.8))
CONFIG = hio.Config.light(
    BOUNDS,
    max_points=300,
    max_range=4.0,
    distance_horizon=1.0,
    near_samples=400,
    far_samples=400,
    local_points=20,
    local_ray_samples=5,
    hidden_width=16,
    hidden_layers=1,
    batches=2,
    warmup_updates=2,
    warmup_epochs=4,
)

# A box to which `grow` can enlarge the room's. Most of it is far from all walls.
LARGER_BOUNDS = ((-2.05, -1.0, -1.5), (1.2, 3.0, 0.8))

# Not on faces of voxels, where rounding decides which voxel a return falls in.
HALF = np.array([0.97, 0.78, 0.56])

# A box before the end of the room, |y| and |z| < BOX_HALF. From the origin it hides a seventh.
BOX_FRONT_X, BOX_HALF = 0.4, 0.42


def room_cloud(seed, count=250, yaw=0.0, position=(0.0, 0.0, 0.0)):
    """Exact returns of a sensor inside the box |x, y, z| < HALF."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pose = np.eye(4, dtype=np.float32)
    c, s = np.cos(yaw), np.sin(yaw)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = position
    world_rays = rays @ pose[:3, :3].T
    reach = (HALF * np.sign(world_rays) - position) / world_rays
    cloud = rays * reach.min(axis=1, keepdims=True)
    return cloud.astype(np.float32), pose


def cloud_with_box(seed, count):
    """Exact returns of a sensor in the middle, where the box stands in the room."""
    cloud, pose = room_cloud(seed, count)
    share = BOX_FRONT_X / np.where(cloud[:, 0] > BOX_FRONT_X, cloud[:, 0], np.inf)
    at_front = np.abs(cloud[:, 1:] * share[:, None]) < BOX_HALF
    share = np.where(at_front.all(axis=1) & (share > 0), share, 1)
    return (cloud * share[:, None]).astype(np.float32), pose


def stream(frames=4, count=250):
    """Posed clouds along a short walk through the room; after twelve it starts again."""
    steps = [i % 12 for i in range(frames)]
    return [
        room_cloud(i, count, 0.3 * i, (0.1 * k - 0.2, 0.05 * k, 0.02 * k))
        for i, k in enumerate(steps)
    ]


def room_sdf(points):
    """Exact distance to the room's walls for points inside, m."""
    return (HALF - np.abs(points)).min(axis=-1)


def map_of_room(config, key, frames=4, count=250):
    """The map after some frames."""
    state = hio.init(config, key)
    for cloud, pose in stream(frames, count):
        state = hio.update(state, cloud, pose)
    return state


def ask(field, points, unknown="network"):
    """The answers of `query` for up to 2,000 points, by one compilation."""
    points = np.asarray(points, np.float32)
    answer = hio.query(field, np.resize(points, (2000, 3)), unknown)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(points)], answer)


def distances(field, points):
    """The distances at up to 2,000 points, by one compilation."""
    points = np.asarray(points, np.float32)
    return np.asarray(hio.sdf(field, np.resize(points, (2000, 3))))[: len(points)]


def arrays_equal(a, b):
    """Whether all arrays of two maps or parts of maps are equal, bit for bit."""

    def plain(tree):
        return [
            np.asarray(
                jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
            )
            for x in jax.tree.leaves(tree)
        ]

    return all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(plain(a), plain(b), strict=True)
    )


def check_snapshot_outlives_its_map(state, donate):
    """Checks that a snapshot answers as before once an update has taken its map's memory."""
    cloud, pose = (jnp.asarray(array) for array in stream(1)[0])
    state = hio.update(state, cloud, pose)
    field = hio.snapshot(state)
    points = np.zeros((2000, 3))  # as many as in other tests: one compilation
    before = hio.query(field, points)
    assert arrays_equal(before, hio.query(state, points))
    donate(state, cloud, pose)
    assert arrays_equal(hio.query(field, points), before)
    assert int(field.updates) == 1
