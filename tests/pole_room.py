"""A room with a thin pole in closed form, as a mesh, as a grid and as a LiDAR stream."""

from functools import cache

import numpy as np
import trimesh

from hiosdf_jax.datasets import FrameStream

HALF = np.array([2.0, 1.5, 1.2])  # of a room around the origin
POLE = np.array([0.8, 0.3])  # x, y of a pole 3 cm thick, from floor to ceiling
ORIGIN = np.zeros((1, 3))


def box_sdf(points, half):
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def room_sdf(points):
    return np.minimum(
        -box_sdf(points, HALF), box_sdf(points - [*POLE, 0], np.array([0.015, 0.015, HALF[2]]))
    )


def room_mesh(pole=True):
    """A room from within: inside out, so that the solid surrounds it."""
    room = trimesh.creation.box(2 * HALF)
    room.invert()
    stand = trimesh.creation.box([0.03, 0.03, 2 * HALF[2]])
    stand.apply_translation([*POLE, 0])
    return trimesh.util.concatenate([room, stand]) if pole else room


@cache
def room_stream(frames=6, noise=0.005):
    """A LiDAR in the room; its ranges come from marching along the closed form."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3000, 3))
    directions[:600] = [*POLE, 0] + rng.normal(size=(600, 3)) * [0.05, 0.05, 0.6]  # to the pole
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)

    @cache
    def read(index):
        pose = np.eye(4)
        pose[:3, 3] = [-0.5 + 0.1 * index, -0.2, 0.1]
        length = np.zeros(len(directions))
        for _ in range(200):
            length += room_sdf(pose[:3, 3] + length[:, None] * directions)
        length += noise * np.random.default_rng(index).normal(size=len(length))
        return length[:, None] * directions, pose

    return FrameStream("room", frames, read)


def points_in(low, high, count=2000, seed=0):
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def slopes(sdf, points, step=1e-5):
    steps = np.eye(3) * step
    return np.stack([(sdf(points + e) - sdf(points - e)) / (2 * step) for e in steps], axis=-1)


def write_grid(folder, sdf, spacing=0.04, margin=0.3):
    low, high = -HALF - margin, HALF + margin
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    values = sdf(low + spacing * index)
    transform = np.diag([spacing] * 3 + [1.0])
    transform[:3, 3] = low
    np.save(folder / "sdf.npy", values)
    np.savetxt(folder / "transform.txt", transform)
    return low, high
