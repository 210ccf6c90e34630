"""Whole maps in the formats of orbax and flax."""

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import serialization
from room import arrays_equal


def test_orbax_keeps_a_map(room_map, tmp_path):
    with ocp.StandardCheckpointer() as keeper:
        keeper.save(tmp_path / "map", room_map)
        keeper.wait_until_finished()
        again = keeper.restore(tmp_path / "map", jax.eval_shape(lambda: room_map))
    assert again.config == room_map.config
    assert arrays_equal(again, room_map)


def test_flax_makes_a_dict_of_a_map(room_map, empty_map):
    tree = serialization.to_state_dict(room_map)
    assert set(tree) == {"grid", "network", "optimism", "key", "updates", "report"}
    assert all(isinstance(leaf, np.ndarray | jax.Array) for leaf in jax.tree.leaves(tree))
    assert arrays_equal(serialization.from_state_dict(empty_map, tree), room_map)
