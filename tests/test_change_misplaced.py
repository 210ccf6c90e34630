"""Clouds that fit the map at another pose: against a slow reference, and against changes."""

import functools
import itertools

import jax
import numpy as np
import pytest
from voxels import CONFIG, anywhere, grid_of_room, rays_to, uniform, update_frontier

from hiosdf_jax._src.change import misplaced

HALF, CENTER = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
SENSOR = np.array([0.33, 0.48, 0.61])
COUNT = 256  # as many as are compared: no draw comes between

NEAR_M = 0.25  # the room is too small for the step of half a meter that is needed elsewhere


def is_misplaced(*args, least_way_m=NEAR_M):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(misplaced, "_LEAST_WAY_M", least_way_m)
        return _compiled(least_way_m)(*args)


@functools.cache
def _compiled(_):
    return jax.jit(lambda *args: misplaced.is_misplaced(*args), static_argnums=0)


@pytest.fixture(scope="module")
def grid():
    """Four exact views of a box room."""
    return update_frontier(CONFIG, grid_of_room(range(4)), anywhere(CENTER))


def view(seed):
    """Exact ends of rays in a cone toward the wall at +x, float64."""
    ahead = np.random.default_rng(seed).uniform(-0.9, 0.9, (COUNT, 3))
    ahead[:, 0] = 1
    ranges = ((HALF * np.sign(ahead) - (SENSOR - CENTER)) / ahead).min(axis=1)
    return SENSOR + ranges[:, None] * ahead


def seen_from(step, turn, points):
    """The same cloud, if its pose is off by a step, m, and a turn about z, rad."""
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return rays_to((points - SENSOR) @ rotation.T + SENSOR + step, SENSOR + step)


def distance_slowly(grid, points):
    """Stored distances, one point after the other; inf in unseen space."""
    sdf = np.abs(np.asarray(grid.derived.sdf, float))
    seen = np.asarray(grid.derived.frontier_steps) > 0
    cells = np.floor(points / 0.1 + 1e-6).astype(int) - CONFIG.corner_index
    inside = ((cells >= 0) & (cells < CONFIG.grid_shape)).all(axis=1)
    return np.array(
        [
            sdf[tuple(c)] if ok and seen[tuple(c)] else np.inf
            for c, ok in zip(cells, inside, strict=True)
        ]
    )


def search_slowly(grid, rays):
    """By the definition: how many more returns agree, share that agrees, share of kept ones."""
    offset = np.asarray(rays.points_world - rays.sensor_world, float)
    sensor = np.asarray(rays.sensor_world, float)

    def distance(x, y, turn):
        cos, sin = np.cos(turn), np.sin(turn)
        turned = offset @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        return distance_slowly(grid, sensor + turned + [x, y, 0])

    def moves(step, count, degrees):
        steps = np.linspace(-step, step, count)
        return itertools.product(steps, steps, np.radians(np.linspace(-degrees, degrees, 5)))

    def misfit(move):
        each = distance(*move)
        return np.where(np.isinf(each), 0.24, np.minimum(each, 0.4)).sum()

    best = sorted(moves(1.2, 9, 20), key=misfit)[:4]
    fine = [distance(*np.add(move, small)) < 0.1 for move in best for small in moves(0.15, 4, 5)]
    there, here = max(fine, key=np.sum), distance(0, 0, 0) < 0.1
    return there.sum() - here.sum(), there.mean(), (there & here).sum() / max(here.sum(), 1)


@pytest.mark.parametrize(
    ("step", "turn"), [((-0.3, 0.2, 0), 0), ((0.3, 0.25, 0), 0.2), ((-0.3, 0, 0), 0)]
)
def test_the_search_is_that_of_a_slow_reference(grid, step, turn):
    rays = seen_from(np.array(step), turn, view(1))
    wrong = np.arange(COUNT) < 60
    assert bool(is_misplaced(CONFIG, grid, rays, wrong))
    # A thing can have moved this far.
    assert not bool(is_misplaced(CONFIG, grid, rays, wrong, least_way_m=0.5))
    gain, share, kept = search_slowly(grid, rays)
    assert gain > 30 and share > 0.55 and (kept > 0.85 or gain == COUNT)
    # A return on the border of two voxels may be in either.
    limit = min(gain / 0.7, COUNT)
    for count, explained in ((limit - 8, True), (limit + 8, gain == COUNT)):
        wrong = np.arange(COUNT) < count
        assert bool(is_misplaced(CONFIG, grid, rays, wrong)) == explained


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_a_thing_that_comes_near_is_not_explained_by_another_pose(grid, share):
    points = view(2)
    near = np.argsort(np.linalg.norm(points - points[7], axis=1))[: round(share * COUNT)]
    ahead = points[near] - SENSOR
    points[near] = SENSOR + 0.12 * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    wrong = np.isin(np.arange(COUNT), near)
    assert not bool(is_misplaced(CONFIG, grid, rays_to(points, SENSOR), wrong))


def test_invalid_rows_and_points_anywhere_do_no_harm(grid):
    rays = seen_from(np.array([0.3, 0, 0]), 0.0, view(3))
    wrong = np.arange(COUNT) < 60
    expected = bool(is_misplaced(CONFIG, grid, rays, wrong))
    assert expected
    nowhere = rays._replace(ends=np.zeros(COUNT, bool))
    assert not bool(is_misplaced(CONFIG, grid, nowhere, wrong))
    bad = uniform(4, 3 * COUNT, (-9, -9, -9), (9, 9, 9))
    step = np.array([0.3, 0, 0])
    more = rays_to(np.concatenate([view(3) + step, bad]), SENSOR + step)
    more = more._replace(ends=np.arange(4 * COUNT) < COUNT)
    assert bool(is_misplaced(CONFIG, grid, more, np.resize(wrong, 4 * COUNT))) == expected
