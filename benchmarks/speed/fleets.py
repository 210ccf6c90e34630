"""Task that times many small maps, updated and asked at once."""

from __future__ import annotations

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks.speed.rows import Measured, Row, single, spread_of, time_ms

_RETURNS = 1000
_UPDATES = 24
_FRAMES = 8
_HALF_M = np.array([1.83, 1.78, 0.87])  # the walls, between the faces of voxels
_SENSORS_M = np.array([1.0, 1.0, 0.4])  # sensors lie within, on either side of the center

CONFIG = hio.Config.light(
    ((-2, -2, -1), (2, 2, 1)),
    max_points=_RETURNS,
    max_range=6.0,
    distance_horizon=1.0,
    near_samples=250,
    far_samples=500,
    local_points=20,
    local_ray_samples=5,
    hidden_width=32,
    batches=1,
    epochs=2,
)
"""A small room as one of many learners or particles maps it."""


def maps_at_once(maps: int, seconds: float) -> Measured:
    """Times the updates and the queries of many rooms, each with a cloud of its own.

    The maps are divided among the devices.

    Args:
        maps: How many rooms.
        seconds: How long to time the queries.

    Returns:
        Rows in ms, the memory of one map, and the mean error of its distances.
    """
    rng = np.random.default_rng(0)
    devices = np.array(jax.devices()[: math.gcd(maps, jax.device_count())])
    sharding = NamedSharding(Mesh(devices, "maps"), PartitionSpec("maps"))
    frames = [
        jax.device_put(_clouds(rng, maps), sharding)
        for _ in tqdm(range(_FRAMES), desc="fleet", leave=False)
    ]
    keys = jax.device_put(jax.random.split(jax.random.key(0), maps), sharding)
    states = jax.jit(jax.vmap(lambda key: hio.init(CONFIG, key)))(keys)
    update = jax.jit(jax.vmap(hio.update), donate_argnums=0)
    times_ms = []
    for k in range(_UPDATES):
        start = time.perf_counter()
        states = jax.block_until_ready(update(states, *frames[k % _FRAMES]))
        times_ms.append(1e3 * (time.perf_counter() - start))
    query = jax.jit(jax.vmap(hio.sdf, in_axes=(0, None)))
    points = jnp.float32(rng.uniform(-1, 1, (256, 3)) * (_HALF_M - 0.05))
    error_m = np.abs(query(states, points) - (_HALF_M - np.abs(points)).min(axis=-1)).mean()
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(states)) / maps
    name, note = f"{maps:,} maps of 4 x 4 x 2 m", f"devices: {devices.size}"
    queried = time_ms(query, states, points, seconds=seconds)
    return Measured(
        [
            Row(f"update of {name}", "ms", spread_of(times_ms[CONFIG.warmup_updates :]), note=note),
            Row(f"256 distances in each of {name}", "ms", queried, note=note),
            Row(f"arrays of each of {name}", "MB", single(1e-6 * size)),
            Row(f"mean error of {name}", "cm", single(100 * float(error_m))),
        ]
    )


def _clouds(rng: np.random.Generator, maps: int) -> tuple[np.ndarray, np.ndarray]:
    """Exact returns of a sensor at a random place in each room, and its poses."""
    rays = rng.normal(size=(maps, _RETURNS, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    positions = rng.uniform(-_SENSORS_M, _SENSORS_M, (maps, 1, 3))
    reach = ((_HALF_M * np.sign(rays) - positions) / rays).min(axis=-1, keepdims=True)
    poses = np.tile(np.eye(4, dtype=np.float32), (maps, 1, 1))
    poses[:, :3, 3] = positions[:, 0]
    return (rays * reach).astype(np.float32), poses
