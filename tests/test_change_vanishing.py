"""Patches that rays look through vanish after some scans; others stay as they are."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from voxels import CONFIG, SHAPE, empty_window, fuse, fuse_hits, rays_to, trace_rays

from hiosdf_jax._src.change import directions, vanishing
from hiosdf_jax._src.numerics.shifts import count_around

SENSOR = np.array([-0.25, 0.55, 0.65])
CELL = (6, 5, 4)  # its center is (0.35, 0.55, 0.65)
CENTER = np.array([0.35, 0.55, 0.65])
WALL = 0.87  # x of the wall behind


@functools.partial(jax.jit, static_argnums=0)
def drop(config, before, window, rays, turn):
    view = directions.view_of(rays)
    return vanishing.drop_vanished(config, before, window, rays, view, turn)


def square(half, count=21):
    """Offsets (y, z) on a square grid."""
    line = np.linspace(-half, half, count)
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


@functools.cache
def patch(columns=10, lines=10):
    """One patch of 9 by 7 cm in the plane of its voxel's center; its axes are y and z."""
    y, z = np.linspace(-0.045, 0.045, columns), np.linspace(-0.035, 0.035, lines)
    offsets = np.stack(np.meshgrid([0.0], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    hits = columns * lines
    points = np.resize(CENTER + offsets, (600, 3)).astype(np.float32)
    window = fuse(empty_window(), points, SENSOR, hit=np.arange(600) < hits)
    assert float(window.hits[CELL]) == hits
    return window


def through(offsets):
    """Ends on the wall of rays that cross the patch's plane at offsets (y, z) from its center."""
    aim = CENTER + np.concatenate([np.zeros((len(offsets), 1)), offsets], axis=1)
    return SENSOR + (aim - SENSOR) * ((WALL - SENSOR[0]) / (CENTER[0] - SENSOR[0]))


def rays_of(ends):
    """Rays to up to 600 ends; other rows are not returns."""
    real = np.arange(600) < len(ends)
    rays = rays_to(np.resize(ends, (600, 3)).astype(np.float32), SENSOR, hit=real)
    return rays._replace(in_range=jnp.asarray(real))


def scan(window, ends, config=CONFIG):
    """The window after a cloud, and the one before patches vanish."""
    rays = rays_of(ends)
    after = trace_rays(CONFIG, fuse_hits(CONFIG, window, rays), rays)
    return drop(config, window, after, rays, 0), after


def state_of(window):
    return float(window.hits[CELL]), int(window.change[CELL])


def scans_until_gone(window, ends, config=CONFIG, most=400):
    """How many scans it takes until the patch has vanished."""
    for count in range(1, most + 1):
        window, _ = scan(window, ends, config)
        if float(window.hits[CELL]) == 0:
            return count
    return None


ALL = square(0.028)
ASIDE = np.add(ALL, [0.3, 0.2])
QUARTERS = {
    "all": (ALL, 3),
    "three": (ALL[(ALL[:, 0] < 0) | (ALL[:, 1] < 0)], 2),
    "half": (ALL[ALL[:, 0] < -0.001], 2),
    "two rays": (np.array([[-0.004, 0.003], [0.004, 0.003]]), 1),
}


@pytest.mark.parametrize("name", QUARTERS)
@pytest.mark.parametrize("scans", [3, 6])
def test_a_patch_that_rays_cross_vanishes_after_some_scans(name, scans):
    """A scan of `vanish_scans` crosses three quarters, or half by three rays or more."""
    offsets, doubt = QUARTERS[name]
    config = dataclasses.replace(CONFIG, vanish_scans=scans)
    window = patch()
    needed = -(-2 * scans // doubt)
    for k in range(1, needed):
        window, _ = scan(window, through(offsets), config)
        assert state_of(window) == (100, -k * doubt)
    gone, after = scan(window, through(offsets), config)
    assert state_of(gone) == (0, -72)
    assert float(gone.weight[CELL]) == float(gone.behind[CELL]) == 0
    assert float(gone.passes[CELL]) >= 1
    others = np.ones(SHAPE, bool)
    others[CELL] = False
    for field, expected in zip(gone, after, strict=True):
        if expected.ndim >= 3:
            np.testing.assert_array_equal(np.asarray(field)[others], np.asarray(expected)[others])


def test_a_patch_vanishes_even_after_the_most_scans_that_can_be_asked_for():
    config = dataclasses.replace(CONFIG, vanish_scans=30)
    count = scans_until_gone(patch(), through(ALL), config, most=100)
    assert count == 20  # a scan through all quarters is worth 3, and 60 are needed


def test_rays_beside_a_patch_leave_it():
    """The patch is half as wide as its voxel; rays pass through the other half of the voxel."""
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-0.049, 0.049, (300, 2)) * [0.4, 1] - [0.025, 0]
    points = CENTER + np.concatenate([np.zeros((300, 1)), offsets], axis=1)
    points = np.resize(points, (600, 3)).astype(np.float32)
    window = fuse(empty_window(), points, SENSOR, hit=np.arange(600) < 300)
    beside = np.add(square(0.02), [0.026, 0])
    for _ in range(12):
        window, after = scan(window, through(beside))
    assert float(after.passes[CELL]) > 100
    assert state_of(window) == (300, 0)
    gone = scans_until_gone(window, through(square(0.012) - [0.025, 0]))
    assert gone == 2


def test_rays_through_one_quarter_or_none_leave_a_patch():
    one = ALL[(ALL[:, 0] > 0.001) & (ALL[:, 1] > 0.001)]
    for offsets in (one, np.add(square(0.02), [0, 0.065])):
        window = patch()
        for _ in range(8):
            window, _ = scan(window, through(offsets))
        assert state_of(window) == (100, 0)


def test_rays_that_end_near_a_patch_do_not_look_through_it():
    """Noise moves ends behind a surface: by up to a voxel and three standard deviations."""
    for beyond, gone in ((0.05, None), (0.09, None), (0.25, 2)):
        ends = through(ALL)
        ahead = ends - SENSOR
        at_patch = (CENTER[0] - SENSOR[0]) / ahead[:, :1]
        unit = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        ends = SENSOR + at_patch * ahead + beyond * unit
        # Other rays make the voxel a suspect.
        ends = np.concatenate([ends, through(np.add(square(0.004, 3), [0, 0.046]))])
        assert scans_until_gone(patch(), ends, most=8) == gone


def test_a_hit_resets_the_count():
    window, _ = scan(patch(), through(ALL))
    assert state_of(window) == (100, -3)
    again, _ = scan(window, np.concatenate([through(ALL), CENTER[None]]))
    assert state_of(again) == (101, 0)
    later, _ = scan(again, through(ALL))
    assert state_of(later) == (101, -3)
    # A scan that does not look there changes nothing.
    elsewhere, _ = scan(window, through(ASIDE))
    assert state_of(elsewhere) == (100, -3)


def test_patches_of_few_hits_vanish_sooner():
    config = dataclasses.replace(CONFIG, vanish_scans=6)
    patches = [patch(3, 2), patch(5, 2), patch(5, 4), patch()]  # 6, 10, 20 and 100 hits
    # 2 ceil(6 hits / 20), at most 12, of which a scan is worth 3 or, with two rays, 1
    assert [scans_until_gone(each, through(ALL), config) for each in patches] == [2, 2, 4, 4]
    two = through(QUARTERS["two rays"][0])
    assert [scans_until_gone(each, two, config) for each in patches] == [4, 6, 12, 12]


def test_new_surfaces_vanish_at_once():
    for quarters, gone in (("half", True), ("all", True)):
        new = patch()._replace(change=jnp.zeros(SHAPE, jnp.int8).at[CELL].set(5))
        after, _ = scan(new, through(QUARTERS[quarters][0]))
        assert (state_of(after) == (0, -72)) == gone
    # It may have moved by less than a voxel.
    for beyond, gone in ((0.02, False), (0.075, True)):
        ends = through(ALL)
        ahead = ends - SENSOR
        at_patch = (CENTER[0] - SENSOR[0]) / ahead[:, :1]
        unit = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        behind = SENSOR + at_patch * ahead + beyond * unit
        after, _ = scan(new, behind[behind[:, 0] > 0.4])
        assert (state_of(after) == (0, -72)) == gone
    # Not where no ray looks, and not where something stands before it.
    for ends in (through(ASIDE), CENTER - [0.2, 0, 0] + 0.001 * through(ALL)):
        kept, _ = scan(new, ends)
        assert state_of(kept) == (100, 5)


def test_a_new_part_that_most_rays_miss_becomes_old_unless_a_ray_should_have_met_it():
    z = np.linspace(-0.035, 0.035, 12)
    strip = CENTER + np.stack([np.zeros(12), np.resize([-0.008, 0.008], 12), z], axis=1)
    points = np.resize(strip, (600, 3)).astype(np.float32)
    window = fuse(empty_window(), points, SENSOR, hit=np.arange(600) < 12)
    new = window._replace(
        change=window.change.at[CELL].set(5), passes=window.passes.at[CELL].set(88.0)
    )
    few = np.array([[y, z] for y in (-0.004, 0.004) for z in (-0.004, 0.004)])
    few = np.concatenate([few, np.zeros((1, 2))])
    assert 5 * 12 < 12 + 93
    once, _ = scan(new, through(few))
    assert state_of(once) == (12, -2)
    twice, _ = scan(once, through(few))  # 12 hits need two of three `vanish_scans`
    assert state_of(twice) == (0, -72)
    many = np.repeat(few, 4, axis=0)
    assert 20 * 12 >= 12 + 108
    at_once, _ = scan(new, through(many))
    assert state_of(at_once) == (0, -72)
    # Rays elsewhere leave it new.
    assert state_of(scan(new, through(ASIDE))[0]) == (12, 5)


@pytest.mark.parametrize(
    ("gone", "left", "vanishes"), [(12, 0, True), (12, 1, False), (7, 0, False)]
)
def test_a_patch_that_no_ray_passes_goes_with_its_neighbors(monkeypatch, gone, left, vanishes):
    """Rays look past it on all sides, but none crosses its voxel."""
    # From farther away, the patch is small in the image.
    monkeypatch.setitem(globals(), "SENSOR", np.array([-1.9, 0.55, 0.65]))
    window = patch()
    change, hits = np.zeros(SHAPE, np.int8), np.array(window.hits)
    corners = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 1) for z in (-1, 1)]
    for step in corners[:gone]:
        change[tuple(np.add(CELL, step))] = -72
    if left:  # six patches that stay, since nothing near them has vanished
        hits[tuple(np.add(CELL, (2, 0, 0)))] = 0
        for y in (-2, 2):
            for x in (0, 1, 2):
                hits[tuple(np.add(CELL, (x, y, 0)))] = 50
    window = window._replace(change=jnp.asarray(change), hits=jnp.asarray(hits))
    beside = square(0.12, 25)
    beside = through(beside[np.abs(beside).max(axis=1) > 0.052])
    after, before = scan(window, beside)
    assert float(before.passes[CELL]) == 0
    assert (state_of(after) == (0, -72)) == vanishes


CORNERS = [(1, 1, 1), (1, -1, 1), (1, 1, -1), (1, -1, -1)]
THING = [(-4, y, z) for y in range(-3, 3) for z in range(-3, 3)]


@pytest.mark.parametrize(
    ("gone", "thing", "crossed", "vanishes"),
    [
        (4, False, 1, True),
        (3, False, 1, False),
        (4, False, 0, False),
        (3, True, 1, True),
        (2, True, 1, False),
        (3, True, 0, False),
    ],
)
def test_a_patch_that_one_ray_crosses_goes_with_its_neighbors(
    monkeypatch, gone, thing, crossed, vanishes
):
    """A thin leg: one ray never crosses two quarters of its patch."""
    monkeypatch.setitem(globals(), "SENSOR", np.array([-1.9, 0.55, 0.65]))
    window = patch()
    change = np.zeros(SHAPE, np.int8)
    for step in CORNERS[:gone] + THING * thing:
        change[tuple(np.add(CELL, step))] = -72
    # Another patch is left, in front of which nothing has vanished.
    hits = window.hits.at[tuple(np.add(CELL, (2, 0, 0)))].set(50)
    window = window._replace(change=jnp.asarray(change), hits=hits)
    aside = square(0.12, 25)
    aside = aside[np.abs(aside).max(axis=1) > 0.055]
    ends = through(np.concatenate([aside, np.array([[0.02, 0.015]])[:crossed]]))
    after, _ = scan(window, ends)
    assert (state_of(after) == (0, -72)) == vanishes


@pytest.mark.parametrize(
    ("gone", "thing", "rays", "passes", "left", "vanishes"),
    [
        (4, True, 8, 0, True, True),
        (4, False, 8, 0, True, False),
        (3, True, 8, 0, True, False),
        (4, True, 1, 900, True, False),
        (4, True, 1, 900, False, True),
        (4, False, 1, 900, False, False),
    ],
)
def test_a_patch_of_a_thing_goes_if_rays_miss_it(
    monkeypatch, gone, thing, rays, passes, left, vanishes
):
    """Rays pass the edge of its voxel, where no patch is.

    Of 1,000 rays 100 ended in it: one more that passes says little, unless no other patch is left.
    """
    monkeypatch.setitem(globals(), "SENSOR", np.array([-1.9, 0.55, 0.65]))
    window = patch()
    change = np.zeros(SHAPE, np.int8)
    for step in CORNERS[:gone] + THING * thing:
        change[tuple(np.add(CELL, step))] = -72
    hits = window.hits
    if left:
        hits = hits.at[tuple(np.add(CELL, (2, 0, 0)))].set(50)
    window = window._replace(
        change=jnp.asarray(change), hits=hits, passes=window.passes.at[CELL].set(passes)
    )
    beside = np.stack([np.linspace(-0.03, 0.03, rays), np.full(rays, 0.0465)], axis=1)
    aside = square(0.12, 25)
    aside = aside[np.abs(aside).max(axis=1) > 0.055]
    ends = through(np.concatenate([aside, beside]))
    after, traced = scan(window, ends)
    assert float(traced.passes[CELL]) > passes
    assert (state_of(after) == (0, -72)) == vanishes


@pytest.mark.parametrize("gone_nearby", [False, True])
def test_stray_returns_that_vanish_take_no_patch_along(gone_nearby):
    """Single hits around a thin leg are no thing that has left, but in the wake of one they are."""
    config = dataclasses.replace(CONFIG, min_hits=2)
    window = patch()._replace(hits=patch().hits.at[CELL].set(1))
    if gone_nearby:
        beside = tuple(np.add(CELL, (1, 1, 1)))
        window = window._replace(change=window.change.at[beside].set(-72))
    after, _ = scan(window, through(ALL), config)
    assert state_of(after) == (0, -72 if gone_nearby else 0)


def test_vanished_places_are_forgotten_after_eight_scans_that_pass_them():
    window = patch()
    for _ in range(2):
        window, _ = scan(window, through(ALL))
    seen = []
    for _ in range(9):
        seen.append(int(window.change[CELL]))
        assert bool(vanishing.is_recent(window.change)[CELL]) == (seen[-1] != 0)
        window, _ = scan(window, through(ALL))
        elsewhere, _ = scan(window, through(ASIDE))
        assert int(elsewhere.change[CELL]) == int(window.change[CELL])
    assert seen == [-72, -71, -70, -69, -68, -67, -66, -65, 0]
    old = jnp.asarray([8, 1, 0, -1, -64, -65, -72], jnp.int8)
    expected = [True, True, False, False, False, True, True]
    np.testing.assert_array_equal(vanishing.is_recent(old), expected)


def test_only_changed_voxels_that_the_cloud_looked_at_are_counted():
    window = patch()
    for _ in range(2):
        before = window
        window, traced = scan(window, through(ALL))
    # The patch was the only surface, and the wall behind it has the other voxels.
    surface = float(np.sum(window.hits > 0))
    assert float(vanishing.share_of_changes(before, traced, window)) == pytest.approx(1 / surface)
    # The mark stays where no ray passes, but is no news there.
    elsewhere, traced = scan(window, through(ASIDE))
    assert int(elsewhere.change[CELL]) == int(window.change[CELL])
    assert float(vanishing.share_of_changes(window, traced, elsewhere)) == 0
    again, traced = scan(elsewhere, through(ALL))
    assert float(vanishing.share_of_changes(elsewhere, traced, again)) > 0


def test_rays_that_are_not_in_range_change_nothing():
    rays = rays_of(through(ALL))._replace(in_range=jnp.zeros(600, bool))
    window = patch()._replace(change=jnp.zeros(SHAPE, jnp.int8).at[CELL].set(5))
    assert arrays_equal(drop(CONFIG, window, window, rays, 0), window)


@pytest.mark.parametrize("rows", [5, 200])
@pytest.mark.parametrize("reach", [2, 4])
def test_voxels_around_some_rows_are_those_around_all(reach, rows):
    rng = np.random.default_rng(0)
    mask = jnp.asarray(rng.random((24, 17, 19)) < 0.2)
    row = jnp.asarray(np.concatenate([[0, mask.size - 1], rng.integers(mask.size, size=rows)]))
    found = jax.jit(vanishing._count_around_rows, static_argnums=2)(mask, row, reach)
    np.testing.assert_array_equal(found, count_around(mask, reach).ravel()[row])
