"""A sphere: its exact distances, as a map and as ground truth."""

import numpy as np

from hiosdf_jax.scoring import GroundTruth

CENTER = np.array([0.3, -0.2, 0.1])
RADIUS = 0.7


def sphere(points):
    offset = points - CENTER
    distance = np.linalg.norm(offset, axis=-1)
    return distance - RADIUS, offset / distance[..., None]


def sphere_truth(count=500, seed=0):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    distance = rng.uniform(0.01, 2.0, count)
    points = (CENTER + direction * (RADIUS + distance[:, None])).astype(np.float32)
    sdf, grad = sphere(points.astype(float))
    return GroundTruth(
        points_world=points,
        sdf=sdf.astype(np.float32),
        grad=grad.astype(np.float32),
        frame=rng.integers(0, 10, count).astype(np.int32),
        surface_points_world=(CENTER + direction[:77] * RADIUS).astype(np.float32),
    )
