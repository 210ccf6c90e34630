"""What is served of grid and network, and how its lower bound is calibrated."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF, map_of_room

import hiosdf_jax as hio
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.grid import lookup
from hiosdf_jax._src.mapping import calibration


@pytest.fixture(scope="module")
def field():
    return hio.snapshot(map_of_room(CONFIG, jax.random.key(0)))


def points_inside(count=400):
    return np.random.default_rng(0).uniform(-HALF, HALF, (count, 3)).astype(np.float32)


def test_near_surfaces_the_network_corrects_the_grid_by_its_share(field):
    points = points_inside()
    grid = np.asarray(lookup.grid_sdf(CONFIG, field.surface, jnp.asarray(points)), float)
    network = np.asarray(blend.network_sdf(field, jnp.asarray(points)), float)
    assert np.abs(network - grid).max() > 0.1 > np.abs(network - grid).min()
    limit = np.minimum(0.1, np.abs(grid))  # surfaces stay where the grid has them
    expected = grid + 0.1 * np.clip(network - grid, -limit, limit)
    assert (np.abs(grid) < 0.8).all()  # of a horizon of 1 m
    np.testing.assert_allclose(hio.sdf(field, points), expected, atol=1e-5)


def test_beyond_the_horizon_the_network_goes_on_alone():
    bounds = ((-3.2, -1.0, -0.8), (1.2, 1.0, 0.8))
    config = dataclasses.replace(CONFIG, bounds=bounds, distance_horizon=0.5)
    field = hio.snapshot(map_of_room(config, jax.random.key(0)))
    x = np.linspace(-3.1, -1.0, 400)
    points = np.stack([x, 0 * x, 0 * x], axis=1).astype(np.float32)
    network = np.asarray(blend.network_sdf(field, jnp.asarray(points)))
    value = np.asarray(hio.sdf(field, points))
    np.testing.assert_allclose(value[x < -2], network[x < -2], atol=1e-6)
    assert np.abs(value - network)[x > -1.1].max() > 0.01
    assert np.abs(np.diff(value)).max() < 0.06  # no jump between the two


def test_the_papers_map_is_the_network_alone(field):
    paper = field.replace(config=dataclasses.replace(CONFIG, grid_share=0.0))
    points = jnp.asarray(points_inside())
    network = blend.network_sdf(paper, points)
    np.testing.assert_allclose(hio.sdf(paper, points), network, atol=1e-6)


def test_lower_is_below_and_by_more_where_grid_and_network_disagree(field):
    points = points_inside(2000)
    answer = hio.query(field, points)
    slack = np.asarray(answer.sdf) - np.asarray(answer.lower)
    assert (slack > 0).all()
    gap = np.abs(blend.network_sdf(field, points) - lookup.grid_sdf(CONFIG, field.surface, points))
    order = np.argsort(gap)
    assert slack[order[-500:]].mean() > 1.2 * slack[order[:500]].mean()
    wilder = field.replace(optimism=field.optimism + 1)
    assert (np.asarray(hio.query(wilder, points).lower) < answer.lower).all()


def test_calibration_follows_the_quantile_of_the_newest_returns(field, monkeypatch):
    def known(_, points):
        return (points[:, 0] + offset) * 0.5, jnp.full(len(points), 0.5)  # a ratio of x + offset

    offset = 1.0

    monkeypatch.setattr(blend, "cautious_sdf", known)
    points = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, (5000, 3)), jnp.float32)
    seen = np.asarray(hio.query(field, points).observed)
    assert seen.mean() > 0.5
    sensor = jnp.asarray([0.3, 0.0, 0.0])
    # What counts is the surface that a return stands for, which grows with its range squared.
    area = np.sum((np.asarray(points) - np.asarray(sensor)) ** 2, axis=1)[seen]
    ordered = np.argsort(points[:, 0][seen])
    share = np.cumsum(area[ordered]) / area.sum()
    expected = offset + float(points[:, 0][seen][ordered][np.argmax(share >= 0.945)])
    field = field.replace(updates=jnp.int32(0), optimism=jnp.float32(9))

    def calibrate(field, ends):
        return float(calibration.calibrate(field, points, ends, sensor, jax.random.key(0)))

    every = jnp.ones(5000, bool)
    assert abs(calibrate(field, every) - expected) < 0.02
    later = field.replace(updates=jnp.int32(1000))
    assert abs(calibrate(later, every) - (0.98 * 9 + 0.02 * expected)) < 0.01
    assert calibrate(field, jnp.asarray(~seen)) == 9
    assert calibrate(field, jnp.zeros(5000, bool)) == 9
    few = jnp.asarray(seen & (np.cumsum(seen) <= 1))  # drawn 2,000 times: enough, as returns go
    assert calibrate(field, few) != 9
    offset = -1.0  # foretold perfectly: free space still needs some
    assert calibrate(field, every) == pytest.approx(calibration._LEAST)


def test_too_few_seen_returns_calibrate_nothing(field):
    known = points_inside(2000)
    points = np.where(np.arange(2000)[:, None] % 40 == 0, known, 0.999 * np.array(CONFIG.bounds[1]))
    seen = np.asarray(hio.query(field, points.astype(np.float32)).observed)
    assert 0 < seen.sum() < 60  # of 2,000 that are drawn with replacement
    field = field.replace(updates=jnp.int32(0), optimism=jnp.float32(9))
    sensor = jnp.zeros(3)
    every = jnp.ones(2000, bool)
    points = jnp.asarray(points, jnp.float32)
    assert float(calibration.calibrate(field, points, every, sensor, jax.random.key(0))) == 9


def test_the_scale_is_of_gap_and_spread(field):
    points = jnp.asarray(points_inside())
    rough = field.surface.replace(axes=field.surface.axes.at[..., 2, :].multiply(200.0))
    field = field.replace(surface=rough)  # the room's walls are smooth
    nearest = lookup.nearest_patch(CONFIG, field.surface, points)
    gap = np.abs(blend.network_sdf(field, points) - nearest.sdf)
    _, scale = blend.cautious_sdf(field, points)
    spread = np.asarray(nearest.spread)
    assert spread.max() > 0.01
    expected = 0.3 * 0.1 + 0.5 * np.minimum(gap, 0.1) + spread
    np.testing.assert_allclose(scale, expected, atol=1e-6)


def test_beyond_the_bounds_nothing_is_doubtful(field):
    nothing = jnp.zeros_like(field.surface.derived.doubt)
    low = np.asarray(CONFIG.bounds[0], np.float32)
    face = jnp.asarray([[low[0], 0.05, 0.05], [low[0] + 0.05, 0.05, 0.05]])
    value = lookup.doubt_distance(CONFIG, field.surface.replace(doubt=nothing), face)
    np.testing.assert_allclose(value, [0.5 * CONFIG.distance_horizon, 0], atol=1e-5)


def test_a_carved_surface_still_counts_for_the_lower_bound():
    """A return that later rays went through is no surface, but may have been a thin one."""
    config = dataclasses.replace(CONFIG, min_hits=1)
    state = hio.init(config, jax.random.key(0))
    pose = np.eye(4)
    thing = np.array([[0.45, 0.05, 0.05]] * 3)
    state = hio.update(state, thing, pose)
    wall = np.array([[0.95, 0.1, 0.1]]) + np.random.default_rng(0).uniform(0, 1e-3, (40, 3))
    for _ in range(2):
        state = hio.update(state, wall * [1, 0.5, 0.5], pose)
    here = jnp.asarray(thing[:1], jnp.float32)
    assert float(lookup.grid_sdf(config, surface_of(state.grid), here)[0]) > 0.3
    assert float(lookup.doubt_distance(config, surface_of(state.grid), here)[0]) < 0.1
    assert float(hio.query(state, here).lower[0]) < 0.05
