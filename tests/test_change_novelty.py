"""Clouds compared with the map before them: what is new in them, and what is a fault."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from voxels import CONFIG, SHAPE, anywhere, grid_of_room, rays_to, uniform, update_frontier

from hiosdf_jax._src.change import novelty

HALF, CENTER = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
SENSOR = np.array([0.33, 0.48, 0.61])
LATER = jnp.int32(5)  # the map can judge a cloud from then on

compare_compiled = jax.jit(novelty.compare_cloud, static_argnums=0)


def compare(grid, rays, updates=LATER):
    return compare_compiled(CONFIG, grid, rays, jnp.asarray(updates, jnp.int32))


@pytest.fixture(scope="module")
def grid():
    """Four exact views of a box room."""
    return update_frontier(CONFIG, grid_of_room(range(4)), anywhere(CENTER))


@functools.cache
def on_walls(seed=9, count=600):
    """Exact returns of another view, float64."""
    ahead = np.random.default_rng(seed).normal(size=(count, 3))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    reach = (HALF * np.sign(ahead) - (SENSOR - CENTER)) / ahead
    return SENSOR + ahead * reach.min(axis=1, keepdims=True)


def wall_distance(points):
    return (HALF - np.abs(points - CENTER)).min(axis=1)


def inner_points(seed, count, share=1.0):
    """Points in the room, float64."""
    low, high = CENTER - share * HALF, CENTER + share * HALF
    return uniform(seed, count, low, high).astype(np.float64)


def cell_of(point):
    return tuple(np.floor(np.asarray(point) / 0.1 + 1e-9).astype(int) - CONFIG.corner_index)


def novel_by_a_loop(grid, rays):
    """The definition, for one return after the other: (novel, near_new, may_join)."""
    known, derived = grid.evidence, grid.derived
    hits, passes = np.asarray(known.hits, float), np.asarray(known.passes, float)
    sdf, change = np.asarray(derived.sdf, float), np.asarray(known.change)
    novel, near_new, may_join = np.zeros((3, len(rays.ends)), bool)
    for k, point in enumerate(np.asarray(rays.points_world, np.float64)):
        if not (rays.ends[k] and rays.inside[k]):
            continue
        cell = cell_of(point)
        jump = np.asarray(derived.nearest[cell], int)
        patch = cell if jump[0] == -128 else tuple(cell + jump)
        near_new[k] = change[cell] > 0 or change[patch] > 0
        if hits[cell] >= max(1, 0.25 * (hits[cell] + abs(passes[cell]))):
            continue  # a surface
        seen = derived.frontier_steps[cell] > 0
        margin = 3 * float(rays.sigma[k])
        free = seen and passes[cell] > 0
        new = free and (sdf[cell] > 0.15 + margin or near_new[k])
        novel[k] = new or (passes[cell] < 0 and near_new[k])
        may_join[k] = free and sdf[cell] > 0.05 + margin
    return novel, near_new, may_join


def test_returns_in_free_space_away_from_surfaces_are_novel_and_others_are_not(grid):
    points = np.concatenate([inner_points(1, 1500), on_walls()])
    rays = rays_to(points, SENSOR)
    found = compare(grid, rays)
    gap, novel = wall_distance(points), np.asarray(found.novel)
    # Distances are those of voxels' centers, up to 87 mm from the return.
    assert novel[gap > 0.15 + 0.087 + 3 * np.asarray(rays.sigma)].all()
    assert not novel[gap < 0.15 - 0.087].any()
    assert not novel[1500:].any()
    assert 100 < novel.sum() < 1000
    assert not np.asarray(found.near_new).any()
    expected, _, beside = novel_by_a_loop(grid, rays)
    np.testing.assert_array_equal(novel, expected)
    np.testing.assert_array_equal(found.may_join, beside)
    assert not beside[1500:].any()
    assert (beside & ~novel).sum() > 100


def test_a_noisy_return_must_be_farther_from_surfaces(grid):
    points = inner_points(2, 1500)
    sdf = np.random.default_rng(0).uniform(-0.1, 0.4, SHAPE)
    grid = grid.replace(derived=grid.derived.replace(sdf=jnp.asarray(sdf, jnp.float16)))
    at = tuple(np.transpose([cell_of(point) for point in points]))
    counts = []
    for noise in (0.001, 0.02, 0.06):
        rays = rays_to(points, SENSOR, noise=(noise, 0.0))
        found = compare(grid, rays)
        novel = np.asarray(found.novel)
        expected, _, beside = novel_by_a_loop(grid, rays)
        np.testing.assert_array_equal(novel, expected)
        np.testing.assert_array_equal(found.may_join, beside)
        assert sdf[at][novel].min() > 0.15 + 3 * noise - 1e-3
        counts.append(novel.sum())
    assert counts[0] > 1.2 * counts[1] > 1.44 * counts[2] > 0


def test_returns_may_join_surfaces_and_in_what_they_hide_are_novel(grid):
    """Some surface voxels are new; a corner of the room is hidden."""
    rng = np.random.default_rng(3)
    known = grid.evidence
    new = rng.random(SHAPE) < 0.1
    hidden = np.zeros(SHAPE, bool)
    hidden[:6, :5] = True
    changed = grid.replace(
        evidence=known.replace(
            change=jnp.asarray(np.where(new, rng.integers(1, 9, SHAPE), -3), jnp.int8),
            passes=jnp.where(hidden, -known.passes, known.passes),
        )
    )
    changed = update_frontier(CONFIG, changed, anywhere(CENTER))
    rays = rays_to(inner_points(4, 1500), SENSOR)
    found = compare(changed, rays)
    novel, near_new, may_join = novel_by_a_loop(changed, rays)
    np.testing.assert_array_equal(found.near_new, near_new)
    np.testing.assert_array_equal(found.may_join, may_join)
    np.testing.assert_array_equal(found.novel, novel)
    at = tuple(np.transpose([cell_of(point) for point in inner_points(4, 1500)]))
    assert (novel & hidden[at]).sum() > 20
    assert (novel & ~near_new).sum() > 20
    assert not (novel & hidden[at] & ~near_new).any()


def clouds():
    """Posed clouds by name, and whether they contradict the map."""
    walls = on_walls()
    rng = np.random.default_rng(5)
    ahead = walls - SENSOR
    ranges = np.linalg.norm(ahead, axis=1, keepdims=True)
    some = rng.random((600, 1))

    def moved(meters):
        return walls + meters * ahead / ranges

    return {
        "the same": (walls, True),
        "noise": (moved(0.005 * rng.normal(size=(600, 1))), True),
        "a moving thing": (np.where(some < 0.3, CENTER + 0.2 * (walls - CENTER), walls), True),
        "twice as long": (SENSOR + 2 * ahead, False),
        "in feet": (SENSOR + 3.28 * ahead, False),
        "through one wall": (np.where(walls[:, :1] > 0.76, SENSOR + 2 * ahead, walls), True),
        "a blob": (CENTER + 0.2 * (walls - CENTER), False),
        "a thing in front of the sensor": (
            np.where(some < 0.7, CENTER + 0.2 * (walls - CENTER), walls),
            False,
        ),
    }


@pytest.mark.parametrize("name", clouds())
def test_a_cloud_that_contradicts_the_map_is_found(grid, name):
    points, consistent = clouds()[name]
    rays = rays_to(points, SENSOR)
    assert bool(compare(grid, rays).consistent) == consistent
    assert bool(compare(grid, rays, 1000).consistent) == consistent
    # A young map cannot judge.
    assert bool(compare(grid, rays, 4).consistent)
    # Returns in unseen space say nothing, and too few others not enough.
    beyond = uniform(6, 4000, (0.83, 0.01, 0.21), (0.89, 0.99, 0.99))
    few = rays_to(np.concatenate([points, beyond]), SENSOR)
    assert bool(compare(grid, few).consistent)


def test_rays_beyond_the_bounds_and_out_of_range_go_through_walls_too(grid):
    ahead = on_walls() - SENSOR
    for factor, ends in ((2, False), (20, False)):
        rays = rays_to(SENSOR + factor * ahead, SENSOR, hit=ends)
        outside = rays._replace(inside=jnp.zeros(600, bool))
        assert not bool(compare(grid, outside).consistent)


def test_rays_through_what_is_new_itself_contradict_nothing(grid):
    rays = rays_to(SENSOR + 2 * (on_walls() - SENSOR), SENSOR)
    new = grid.evidence.replace(change=jnp.full(SHAPE, 3, jnp.int8))
    assert bool(compare(grid.replace(evidence=new), rays).consistent)


def dense_view(share, kind):
    """20,000 returns toward the x walls; those beyond a part of the view are on something else."""
    rng = np.random.default_rng(8)
    ahead = np.stack([np.ones(20_000), *rng.uniform(-0.6, 0.6, (2, 20_000))], axis=1)
    covered = ahead[:, 1] < -0.6 + 1.2 * share
    reach = ((HALF * np.sign(ahead) - (SENSOR - CENTER)) / ahead).min(axis=1)
    other = {"board": 0.15, "random": rng.uniform(0.02, 0.8, 20_000), "scaled": 0.35 * reach}
    return rays_to(SENSOR + ahead * np.where(covered, other[kind], reach)[:, None], SENSOR)


@pytest.mark.parametrize(
    ("share", "kind", "consistent", "noise"),
    [
        (0.0, "board", True, False),
        (0.8, "board", True, False),  # a thing that fills most of the view
        (1.0, "board", False, False),  # a covered lens: nothing beside it agrees
        (1.0, "scaled", False, False),
        (1.0, "random", False, True),
    ],
)
def test_a_thing_that_fills_the_view_is_news_and_noise_is_not(grid, share, kind, consistent, noise):
    found = compare(grid, dense_view(share, kind))
    assert (bool(found.consistent), bool(found.noise)) == (consistent, noise)


@pytest.mark.parametrize(
    ("novel", "unseen", "consistent"),
    [(0.45, 0.0, True), (0.55, 0.0, False), (0.25, 0.5, True), (0.3, 0.5, False)],
)
def test_a_cloud_may_be_new_up_to_half_of_what_can_be_compared(grid, novel, unseen, consistent):
    """Returns in unseen space can not be compared."""
    free, beyond = (
        inner_points(7, 5000, 0.3),
        uniform(6, 5000, (0.83, 0.01, 0.21), (0.89, 0.9, 0.9)),
    )
    counts = [round(1000 * share) for share in (1 - novel - unseen, novel, unseen)]
    parts = zip((on_walls(), free, beyond), counts, strict=True)
    points = np.concatenate([np.resize(part, (count, 3)) for part, count in parts])
    rays = rays_to(points, SENSOR)
    found = compare(grid, rays)
    assert np.asarray(found.novel).sum() == counts[1]
    assert bool(found.consistent) == consistent
    # With so much noise nobody can tell.
    assert bool(compare(grid, rays._replace(sigma=rays.sigma + 0.2)).consistent)


def test_new_things_say_nothing_about_the_whole_cloud(grid):
    points, _ = clouds()["a blob"]
    rays = rays_to(points, SENSOR)
    new = grid.evidence.replace(change=jnp.full(SHAPE, 3, jnp.int8))
    found = compare(grid.replace(evidence=new), rays)
    assert bool(found.consistent)
    assert np.asarray(found.novel).mean() > 0.9


def test_invalid_rows_change_nothing(grid):
    points = np.concatenate([inner_points(1, 300), on_walls()])
    rays = rays_to(points, SENSOR)
    found = compare(grid, rays)
    count = len(points)
    others = np.concatenate([inner_points(10, 400, 0.3), np.full((200, 3), 7.0)])
    real = np.arange(count + 600) < count
    padded = rays_to(np.concatenate([points, others]), SENSOR, hit=real)._replace(in_range=real)
    again = compare(grid, padded)
    assert arrays_equal(found.novel, again.novel[:count])
    assert bool(again.consistent) == bool(found.consistent)
    assert not np.asarray(again.novel)[count:].any()
    assert not np.asarray(again.near_new)[count:].any()
    # Points outside of the bounds are not looked up, even where their rays end.
    outside = padded._replace(
        ends=jnp.ones(count + 600, bool), inside=jnp.arange(count + 600) < count
    )
    assert arrays_equal(compare(grid, outside).novel, again.novel)
