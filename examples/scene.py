"""The scene of the examples: a closed, furnished room, scanned in simulation from six places."""

import jax
import numpy as np

import hiosdf_jax as hio

ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 4.0, 2.0]])  # m
BOXES = np.array(
    [
        [[2.0, 1.2, 0.0], [2.6, 2.8, 0.5]],  # a table
        [[0.6, 0.8, 0.0], [0.9, 1.1, 2.0]],  # a pillar
        [[2.9, 3.0, 0.0], [3.3, 4.0, 1.4]],  # a cupboard
    ]
)
LAMP, LAMP_RADIUS = np.array([2.0, 2.5, 1.1]), 0.2
VIEWPOINTS = (
    *((0.5, 0.5, 1.6), (3.5, 0.5, 1.6), (0.5, 3.5, 1.6)),
    *((2.5, 3.4, 0.8), (1.2, 2.2, 0.6), (2.2, 0.6, 1.0)),
)


def exact_sdf(points_world):
    """Exact signed distance, (..., 3) m -> (...) m, float64; inside of solids a bound."""
    points = np.asarray(points_world, np.float64)
    distance = np.minimum(points - ROOM[0], ROOM[1] - points).min(axis=-1)
    for low, high in BOXES:
        beyond = np.abs(points - (low + high) / 2) - (high - low) / 2
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
        distance = np.minimum(distance, outside + np.minimum(beyond.max(axis=-1), 0))
    return np.minimum(distance, np.linalg.norm(points - LAMP, axis=-1) - LAMP_RADIUS)


def scan(position_world, rays, rng):
    """Simulates a LiDAR scan: (rays, 3) m in the sensor frame, and (4, 4) T_world_sensor."""
    directions = rng.normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = np.zeros(rays)
    for _ in range(100):  # Sphere tracing: no surface is nearer than the distance.
        ranges += exact_sdf(position_world + ranges[:, None] * directions)
    pose = np.eye(4)
    pose[:3, 3] = position_world
    return (ranges[:, None] * directions).astype(np.float32), pose


def build_map(rays=10_000, **overrides):
    """Maps the room from all viewpoints by `Config.light` with overrides."""
    settings = {"bounds": (ROOM[0] - 0.2, ROOM[1] + 0.2), "max_points": rays} | overrides
    state = hio.init(hio.Config.light(**settings), jax.random.key(0))
    rng = np.random.default_rng(0)
    for position in VIEWPOINTS:
        state = hio.update(state, *scan(np.array(position), rays, rng))
    return state
