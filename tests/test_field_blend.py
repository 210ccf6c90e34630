"""The blend of grid and network, and its lower bound."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF, LARGER_BOUNDS, map_of_room

import hiosdf_jax as hio
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.grid import interpolation, lookup
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Side, surface_of

grid_sdf = jax.jit(lookup.grid_sdf, static_argnums=0)
doubt_distance = jax.jit(interpolation.doubt_distance, static_argnums=0)
network_sdf = jax.jit(blend.network_sdf)


@pytest.fixture(scope="module")
def field(room_map):
    return hio.snapshot(room_map)


def points_inside(count=2000):
    return np.random.default_rng(0).uniform(-HALF, HALF, (count, 3)).astype(np.float32)


def test_near_surfaces_the_network_corrects_the_grid_by_its_share(field):
    points = points_inside()
    points = points[np.asarray(hio.query(field, points).frontier) > -0.1]  # beyond, it fades
    assert len(points) > 1900
    grid = np.asarray(grid_sdf(CONFIG, field.surface, points), float)
    network = np.asarray(network_sdf(field, points), float)
    assert np.abs(network - grid).max() > 0.1 > np.abs(network - grid).min()
    limit = np.clip(np.abs(grid) - 0.02, 0, 0.1)  # surfaces stay where the grid has them
    expected = grid + 0.1 * np.clip(network - grid, -limit, limit)
    assert (np.abs(grid) < 0.8).all()  # of a horizon of 1 m
    np.testing.assert_allclose(hio.sdf(field, points), expected, atol=1e-5)


def test_beyond_the_horizon_the_network_answers_alone():
    config = dataclasses.replace(CONFIG, bounds=LARGER_BOUNDS)
    field = hio.snapshot(map_of_room(config, jax.random.key(0)))
    y = np.linspace(0.8, 2.9, 2000)
    points = np.stack([0 * y, y, 0 * y], axis=1).astype(np.float32)
    network = np.asarray(network_sdf(field, points))
    value = np.asarray(hio.sdf(field, points))
    np.testing.assert_allclose(value[y > 1.8], network[y > 1.8], atol=1e-6)
    assert np.abs(value - network)[y < 0.9].max() > 0.01
    assert np.abs(np.diff(value)).max() < 0.06  # no jump between the two


@pytest.mark.parametrize("remembered_m", [-2.0, 2.0])
def test_in_unseen_obstacles_what_the_network_remembers_does_not_count(remembered_m):
    """It may remember free space where a thing is now: its gradient would hold points inside."""
    config = dataclasses.replace(CONFIG, bounds=LARGER_BOUNDS)
    field = hio.snapshot(map_of_room(config, jax.random.key(0)))
    points = np.random.default_rng(1).uniform(*LARGER_BOUNDS, (2000, 3)).astype(np.float32)
    answer = hio.query(field, points, "obstacle")
    unseen = np.asarray(answer.frontier) < 0
    assert unseen.sum() > 500
    last = f"Dense_{CONFIG.hidden_layers + 1}"
    layers = dict(field.params["params"])
    layers[last] = layers[last] | {"bias": layers[last]["bias"] + remembered_m}
    other = hio.query(field.replace(params={"params": layers}), points, "obstacle")
    # The network corrects the grid by a tenth of its difference, of at most a voxel.
    change = np.abs(np.asarray(other.sdf) - np.asarray(answer.sdf))[unseen]
    assert change.max() < 0.021
    assert (np.asarray(other.sdf) <= np.asarray(answer.frontier) + 1e-6)[unseen].all()


def test_the_papers_map_is_the_network_alone(field):
    paper = field.replace(config=dataclasses.replace(CONFIG, grid_share=0.0))
    points = jnp.asarray(points_inside())
    network = network_sdf(paper, points)
    np.testing.assert_allclose(hio.sdf(paper, points), network, atol=1e-6)


def test_in_observed_space_the_sign_changes_only_near_patches(room_map):
    """Also where rays contradict each other: here each voxel's side is random."""
    derived = room_map.grid.derived
    shape, sides = derived.side.shape, [Side.BEHIND, Side.FREE]
    side = np.random.default_rng(1).choice(sides, shape).astype(np.int8)
    steps = jnp.full_like(derived.frontier_steps, 5)
    derived = derived.replace(side=jnp.asarray(side), frontier_steps=steps)
    field = hio.snapshot(room_map.replace(grid=room_map.grid.replace(derived=derived)))
    start = np.random.default_rng(2).uniform(-HALF, HALF, (200_000, 3)).astype(np.float32)
    turn = np.random.default_rng(3).normal(size=start.shape)
    end = start + 0.0025 * turn / np.linalg.norm(turn, axis=1, keepdims=True)
    sdf = jax.jit(hio.sdf)
    flips = np.flatnonzero((sdf(field, start) < 0) != (sdf(field, end) < 0))
    start, end = start[flips], end[flips].astype(np.float32)
    seen = np.asarray(hio.query(field, start).observed & hio.query(field, end).observed)
    paper = field.replace(config=dataclasses.replace(CONFIG, grid_share=0.0))
    same = hio.query(paper, start).observed == hio.query(field, start).observed
    assert np.asarray(same).all()  # the grid decides also where the network answers
    away = distance_to_patches(room_map.grid, start)
    assert seen.sum() > 20
    assert (away[seen] < 0.05 + 0.0025).all()
    assert (away[~seen] > 0.06).sum() > 1000


def distance_to_patches(grid, points_world):
    """Distances of points from the nearest of all rectangles, (N,) m, float64."""
    nearest = np.asarray(grid.derived.nearest, int)
    known = np.argwhere(nearest[..., 0] != NO_FEATURE)
    sites = np.unique(known + nearest[tuple(known.T)], axis=0)
    mean, axes = (
        np.asarray(array, float)[tuple(sites.T)]
        for array in (grid.evidence.mean, grid.evidence.axes)
    )
    offset = (np.asarray(points_world, float) / 0.1 - CONFIG.corner_index)[:, None] - sites - 0.5
    inside = offset
    offset = offset - mean
    for axis in (0, 1):
        half = 0.9 * 3**0.5 * axes[:, axis]
        share = np.sum(offset * half, axis=-1) / np.sum(half * half, axis=-1)
        offset = offset - np.clip(share, -1, 1)[..., None] * half
    at = np.clip(inside - offset, -0.6, 0.6)
    return 0.1 * np.linalg.norm(inside - at, axis=-1).min(axis=1)


def test_lower_is_below_and_by_more_where_grid_and_network_disagree(field):
    points = points_inside()
    answer = hio.query(field, points)
    slack = np.asarray(answer.sdf) - np.asarray(answer.lower)
    assert (slack > 0).all()
    wilder = field.replace(optimism=field.optimism + 1)
    wilder = np.asarray(hio.query(wilder, points).lower)
    observed, lower = np.asarray(answer.observed), np.asarray(answer.lower)
    gap = np.abs(network_sdf(field, points) - grid_sdf(CONFIG, field.surface, points))
    order = np.argsort(gap[observed])
    scale = (lower - wilder)[observed]
    assert scale[order[-500:]].mean() > 1.2 * scale[order[:500]].mean()
    assert (wilder < lower)[observed].all()
    # In unseen space the frontier may be lower than either bound.
    assert ((wilder < lower) | (lower == answer.frontier))[~observed].all()
    assert 0.5 < observed.mean() < 1


def test_the_error_scale_adds_gap_and_spread(field):
    points = jnp.asarray(points_inside())
    rough = field.surface.replace(axes=field.surface.axes.at[..., 2, :].multiply(200.0))
    field = field.replace(surface=rough)  # the room's walls are smooth
    nearest = jax.jit(lookup.nearest_patch, static_argnums=0)(CONFIG, field.surface, points)
    gap = np.abs(network_sdf(field, points) - nearest.sdf)
    _, scale = jax.jit(blend.cautious_sdf)(field, points)
    spread = np.asarray(nearest.spread)
    assert spread.max() > 0.01
    expected = 0.3 * 0.1 + 0.5 * np.minimum(gap, 0.1) + spread
    np.testing.assert_allclose(scale, expected, atol=1e-6)


def test_beyond_the_bounds_nothing_is_doubtful(field):
    derived = field.surface.derived
    surface = field.surface.replace(derived=derived.replace(doubt=jnp.zeros_like(derived.doubt)))
    low = np.asarray(CONFIG.bounds[0], np.float32)
    face = jnp.asarray([[low[0], 0.05, 0.05], [low[0] + 0.05, 0.05, 0.05]])
    value = doubt_distance(CONFIG, surface, face)
    np.testing.assert_allclose(value, [0.5 * CONFIG.distance_horizon, 0], atol=1e-5)


def test_a_carved_surface_still_counts_for_the_lower_bound(empty_map):
    """A return that later rays went through is no surface, but may have been a thin one."""
    pose = np.eye(4)
    thing = np.array([[0.45, 0.05, 0.05]] * 3)
    state = hio.update(empty_map, thing, pose)
    here = jnp.asarray(thing[:1], jnp.float32)
    assert abs(float(grid_sdf(CONFIG, surface_of(state.grid), here)[0])) < 0.01
    wall = np.array([[0.95, 0.1, 0.1]]) + np.random.default_rng(0).uniform(0, 1e-3, (40, 3))
    for _ in range(3):
        state = hio.update(state, wall * [1, 0.5, 0.5], pose)
    assert float(grid_sdf(CONFIG, surface_of(state.grid), here)[0]) > 0.3
    assert float(doubt_distance(CONFIG, surface_of(state.grid), here)[0]) < 0.1
    assert float(hio.query(state, here).lower[0]) < 0.05
