"""Grids for other planners: cuRobo's voxels and a costmap."""

import jax
import numpy as np
import pytest
from room import BOUNDS, CONFIG, HALF, map_of_room

import hiosdf_jax as hio
from hiosdf_jax import exports
from hiosdf_jax._src.view.exports.navigation import _within_of_edge

ROBOT = {"floor_m": -HALF[2], "height_m": 0.7, "radius_m": 0.15}
FREE, UNKNOWN, OCCUPIED = 254, 128, 0


@pytest.fixture(scope="module")
def field(sharp_map):
    return hio.snapshot(sharp_map)


@pytest.mark.parametrize("unknown", ["obstacle", "network"])
def test_voxels_are_minus_the_distances_at_their_centers(field, unknown):
    grid = exports.voxel_grid(field, 0.2, unknown=unknown)
    shape = np.rint(np.array(grid.dims) / grid.voxel_size).astype(int)
    assert tuple(shape) == (12, 10, 8) and grid.voxel_size == 0.2
    np.testing.assert_allclose(grid.pose, [0, 0, 0, 1, 0, 0, 0], atol=1e-6)
    values = np.asarray(grid.feature_tensor)
    assert values.dtype == np.float16 and values.shape == (shape.prod(),)
    # x runs slowest and z fastest, from the least corner.
    at = [(np.arange(n) + 0.5) * 0.2 - size / 2 for n, size in zip(shape, grid.dims, strict=True)]
    centers = np.array(grid.pose[:3]) + np.stack(np.meshgrid(*at, indexing="ij"), -1).reshape(-1, 3)
    distance = np.asarray(hio.sdf(field, centers.astype(np.float32), unknown=unknown), float)
    np.testing.assert_allclose(values, -distance, atol=2e-3)
    assert (values >= -distance - 1e-6).all()  # rounding never frees space
    assert (values > 0).any() and (values < 0).any()


def test_other_libraries_take_voxels_without_a_copy(field):
    grid = exports.voxel_grid(field, 0.2)
    taken = np.from_dlpack(grid.feature_tensor)
    assert taken.dtype == np.float16
    assert taken.__array_interface__["data"][0] == grid.feature_tensor.unsafe_buffer_pointer()


def cell_of(grid, x, y):
    column = int(np.floor((x - grid.origin_world[0]) / grid.resolution))
    row = int(np.floor((y - grid.origin_world[1]) / grid.resolution))
    return grid.cells[row, column]


def test_the_room_is_free_inside_occupied_at_walls_and_unknown_beyond(field):
    grid = exports.costmap(field, **ROBOT)
    assert grid.cells.shape == (40, 48) and grid.cells.dtype == np.uint8
    assert grid.origin_world == BOUNDS[0][:2]
    assert cell_of(grid, 0.0, 0.0) == FREE
    assert cell_of(grid, HALF[0], 0.0) == cell_of(grid, 0.0, -HALF[1]) == OCCUPIED
    assert cell_of(grid, HALF[0] - 0.1, 0.1) == OCCUPIED  # the robot would touch the wall
    assert (grid.cells == FREE).mean() > 0.2


@pytest.mark.parametrize("resolution", [0.05, 0.1])
def test_a_robot_may_stand_anywhere_in_a_free_cell(field, resolution):
    """Against the exact walls, and against the map's own answers at points in the robot."""
    grid = exports.costmap(field, **ROBOT, resolution=resolution)
    rows, columns = np.nonzero(grid.cells == FREE)
    assert len(rows) > 20
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(rows), 4000)
    at = np.stack([columns[pick], rows[pick]], axis=1) + rng.uniform(size=(4000, 2))
    at = np.array(grid.origin_world) + at * resolution
    angle, share = rng.uniform(0, 2 * np.pi, 4000), np.sqrt(rng.uniform(size=4000))
    side = ROBOT["radius_m"] * share[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = ROBOT["floor_m"] + rng.uniform(0.1, ROBOT["height_m"], 4000)
    body = np.concatenate([at + side, z[:, None]], axis=1).astype(np.float32)
    assert (np.abs(body[:, :2]) < HALF[:2]).all()
    answer = hio.query(field, body)
    assert np.asarray(answer.observed).all()
    assert (np.asarray(answer.sdf) > 0).all() and (np.asarray(answer.lower) > 0).all()


def test_the_walls_grow_by_the_radius_and_little_more(field):
    """Against a plain loop over the cells that the walls touch."""
    grid = exports.costmap(field, **ROBOT)
    edge = 0.05
    step = np.arange(edge / 8, edge, edge / 4)
    hit = np.zeros(grid.cells.shape, bool)
    for row, column in np.ndindex(grid.cells.shape):
        x = grid.origin_world[0] + column * edge + step
        y = grid.origin_world[1] + row * edge + step
        if max(abs(x).max(), abs(y).max()) < 0.5:
            continue  # far from all walls
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        hit[row, column] = not (np.abs(points) < HALF[:2] - 0.03).all()
    rows, columns = np.nonzero(grid.cells == FREE)
    wall_rows, wall_columns = np.nonzero(hit)
    gaps = np.hypot(rows[:, None] - wall_rows, columns[:, None] - wall_columns) * edge
    assert gaps.min() > ROBOT["radius_m"]
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    gaps = np.hypot(rows[:, None] - wall_rows, columns[:, None] - wall_columns) * edge
    assert gaps.min(axis=1).max() < ROBOT["radius_m"] + 4 * edge


def test_an_unseen_map_is_unknown(empty_map):
    assert set(np.unique(exports.costmap(empty_map, **ROBOT).cells)) == {UNKNOWN}


def test_a_half_seen_map_is_free_nowhere_near_what_is_unseen():
    state = map_of_room(CONFIG, jax.random.key(0), 1)
    grid = exports.costmap(state, **ROBOT)
    assert (grid.cells == UNKNOWN).any() or (grid.cells == OCCUPIED).all()
    rows, columns = np.nonzero(grid.cells == FREE)
    for row, column in zip(rows, columns, strict=True):
        x, y = np.array(grid.origin_world) + (np.array([column, row]) + 0.5) * 0.05
        z = np.arange(ROBOT["floor_m"] + 0.1, ROBOT["floor_m"] + ROBOT["height_m"], 0.05)
        points = np.stack([np.full_like(z, x), np.full_like(z, y), z], axis=1)
        assert np.asarray(hio.query(state, points).observed).all()


def test_cells_from_which_the_robot_would_leave_the_map():
    edge = _within_of_edge((9, 7), 2.0)
    assert edge[:2].all() and edge[-2:].all() and edge[:, :2].all() and edge[:, -2:].all()
    assert not edge[2:-2, 2:-2].any()


def test_wrong_arguments_are_named(field):
    for wrong, message in (
        ({"radius_m": -1.0}, "radius_m is -1.0, expected >= 0"),
        ({"step_m": 0.01}, "step_m is 0.01, expected >= 0.05"),
        ({"height_m": 0.05}, "height_m is 0.05, expected > 0.1"),
        ({"floor_m": np.nan}, "floor_m is nan"),
        ({"floor_m": 5.0}, "the robot reaches from 5.10 to 5.70 m, expected heights inside"),
        ({"resolution": 0}, "resolution"),
    ):
        with pytest.raises(ValueError, match=message):
            exports.costmap(field, **(ROBOT | wrong))
    with pytest.raises(ValueError, match="field is int"):
        exports.costmap(3, **ROBOT)
    with pytest.raises(ValueError, match="resolution"):
        exports.voxel_grid(field, -0.1)
    with pytest.raises(ValueError, match="field is int"):
        exports.voxel_grid(3)
