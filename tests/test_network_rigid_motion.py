"""A network in another frame answers as before."""

import jax
import jax.numpy as jnp
import numpy as np
from room import arrays_equal
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.network.rigid_motion import move_network


def answers(network, config, params, points):
    """A SIREN in float64."""
    rows = np.asarray(points, float) - np.asarray(network.origin_world, float)
    layers = params["params"]
    names = sorted(layers, key=lambda name: int(name.split("_")[1]))
    for k, name in enumerate(names):
        rows = rows @ np.asarray(layers[name]["kernel"], float) + np.asarray(layers[name]["bias"])
        if k < len(names) - 1:
            rows = np.sin(config.frequency * rows)
    return rows[:, 0]


def test_it_answers_as_before_at_the_moved_points(room_map):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.4, 1.2, -2.0]).as_matrix()
    pose[:3, 3] = (3.0, -2.0, 0.7)
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    network = room_map.network
    moved = move_network(network, jnp.asarray(pose, jnp.float32))
    there = points @ pose[:3, :3].T + pose[:3, 3]
    for name in ("params", "average"):
        before = answers(network, room_map.config, getattr(network, name), points)
        after = answers(moved, room_map.config, getattr(moved, name), there)
        np.testing.assert_allclose(after, before, atol=2e-5)
        assert before.std() > 0.01


def test_the_identity_keeps_every_bit(room_map):
    assert arrays_equal(move_network(room_map.network, jnp.eye(4)), room_map.network)


def test_the_mean_gradient_turns_with_its_weights(room_map):
    """What AdamW remembers is that of the moved network: of gradients by the moved kernel."""
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = Rotation.from_rotvec([0.3, 0.1, 0.8]).as_matrix()
    before, after = (
        np.asarray(network.optimizer[0].mu["params"]["Dense_0"]["kernel"], float)
        for network in (room_map.network, move_network(room_map.network, jnp.asarray(pose)))
    )
    np.testing.assert_allclose(after, pose[:3, :3] @ before, atol=1e-7)
    assert np.abs(before).max() > 1e-6
    squares = jax.tree.leaves(move_network(room_map.network, jnp.asarray(pose)).optimizer[0].nu)
    assert all((np.asarray(leaf) >= 0).all() for leaf in squares)
