"""Forgetting a box: unobserved inside, untouched elsewhere."""

import jax
import numpy as np
import pytest
from room import BOUNDS, CONFIG, arrays_equal, ask, stream

import hiosdf_jax as hio
from hiosdf_jax._src.grid.evidence import empty_grid
from hiosdf_jax._src.state.pytrees import NO_FEATURE

BOX = ((0.6, -0.5, -0.5), (2.0, 0.5, 0.5))  # a part of a wall, and beyond the bounds


@pytest.fixture(scope="module")
def forgotten(room_map):
    return hio.forget(room_map, BOX)


def voxels_in_box():
    index = np.indices(CONFIG.grid_shape).transpose(1, 2, 3, 0)
    centers = (index + CONFIG.corner_index + 0.5) * CONFIG.voxel_size
    return index, np.all((centers >= BOX[0]) & (centers <= BOX[1]), axis=-1)


def test_evidence_is_gone_inside_and_equal_outside(room_map, forgotten):
    _, inside = voxels_in_box()
    assert 0 < inside.sum() < inside.size
    pairs = zip(
        jax.tree.leaves(forgotten.grid.evidence),
        jax.tree.leaves(room_map.grid.evidence),
        strict=True,
    )
    for after, before in pairs:
        after, before = np.asarray(after), np.asarray(before)
        assert not after[inside].any()
        np.testing.assert_array_equal(after[~inside], before[~inside])
    assert np.asarray(room_map.grid.evidence.hits)[inside].any()


def test_points_inside_are_unseen_and_solid_on_request(forgotten):
    points = np.random.default_rng(0).uniform((0.65, -0.45, -0.45), (0.95, 0.45, 0.45), (500, 3))
    answer = ask(forgotten, points, "obstacle")
    assert not np.asarray(answer.observed).any()
    assert (np.asarray(answer.sdf) < 0).all() and (np.asarray(answer.lower) < 0).all()


def test_no_voxel_names_a_forgotten_patch(room_map, forgotten):
    index, inside = voxels_in_box()

    def named(state):
        nearest = np.asarray(state.grid.derived.nearest, int)
        found = nearest[..., 0] != NO_FEATURE
        return inside[tuple((index + nearest)[found].T)]

    assert named(room_map).any()
    assert not named(forgotten).any()


def test_far_from_the_box_all_distances_are_equal(room_map, forgotten):
    index, inside = voxels_in_box()
    apart = np.abs(index[..., 0] - np.argwhere(inside)[:, 0].min()) > CONFIG.horizon_voxels
    for name in ("nearest", "sdf", "doubt"):
        before, after = (getattr(state.grid.derived, name) for state in (room_map, forgotten))
        np.testing.assert_array_equal(np.asarray(after)[apart], np.asarray(before)[apart])


def test_who_forgets_all_has_an_empty_grid(room_map):
    nothing = hio.forget(room_map, ((-9, -9, -9), (9, 9, 9)))
    assert arrays_equal(nothing.grid, empty_grid(CONFIG))
    assert arrays_equal(nothing.network, room_map.network)


def test_the_same_clouds_fill_the_box_again(room_map, forgotten):
    state = forgotten
    for cloud, pose in stream(4):
        state = hio.update(state, cloud, pose)
    points = np.random.default_rng(1).uniform((0.65, -0.3, -0.3), (0.9, 0.3, 0.3), (300, 3))
    before, after = (ask(each, points) for each in (room_map, state))
    seen = np.asarray(before.observed)
    assert seen.mean() > 0.3
    assert np.asarray(after.observed)[seen].mean() > 0.98


@pytest.mark.parametrize(
    "box", [3, ((0, 0, 0),), ((0, 0, 0), (1, 1, np.nan)), ((1, 0, 0), (0, 1, 1)), "wall"]
)
def test_a_bad_box_is_named(room_map, box):
    with pytest.raises(ValueError, match=r"box (is|has dtype)"):
        hio.forget(room_map, box)


def test_a_traced_box_is_named(room_map):
    for forget in (hio.forget, lambda state, box: hio.forget(state, (box[0], box[1]))):
        with pytest.raises(ValueError, match="box is traced, expected concrete numbers"):
            jax.jit(forget)(room_map, np.asarray(BOX))


def test_what_is_no_map_is_named():
    with pytest.raises(ValueError, match="state is tuple"):
        hio.forget(BOUNDS, BOX)
