"""New surfaces outweigh old passes and hide what is behind them, against geometry and loops."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from voxels import CONFIG, SHAPE, empty_window, fuse_hits, rays_to, trace_rays, uniform

from hiosdf_jax._src.change import directions, hiding
from hiosdf_jax._src.change.novelty import Novelty
from hiosdf_jax._src.grid.evidence import is_reached

SENSOR = np.array([-0.25, 0.52, 0.61])
PLATE = np.array([0.18, 0.42, 0.53]), np.array([0.18, 0.63, 0.70])  # opposite corners
WALL = 0.87  # x of the far wall

add_new = jax.jit(hiding.add_new_surfaces, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def hide(config, before, window, rays, fresh):
    return hiding.hide_behind(config, before, window, rays, directions.view_of(rays), fresh)


def centers():
    """Centers of all voxels, (X, Y, Z, 3) m."""
    return (np.stack(np.indices(SHAPE), axis=-1) + CONFIG.corner_index + 0.5) * 0.1


def sheet(x, low, high, count):
    """A grid of points in a plane of constant x."""
    y, z = np.linspace(low[1], high[1], count), np.linspace(low[2], high[2], count)
    y, z = np.meshgrid(y, z, indexing="ij")
    return np.stack([np.full_like(y, x), y, z], axis=-1).reshape(-1, 3)


def meets_plate(points, margin):
    """Whether rays from the sensor to points meet the plate enlarged by a margin."""
    ahead = points - SENSOR
    at = SENSOR + ahead * ((PLATE[0][0] - SENSOR[0]) / np.maximum(ahead[..., :1], 1e-9))
    grown = (at[..., 1:] > PLATE[0][1:] - margin) & (at[..., 1:] < PLATE[1][1:] + margin)
    return grown.all(axis=-1) & (points[..., 0] > PLATE[0][0])


ROWS = 16_000


def rays_of(points):
    """Rays to points; the other rows are not returns. One shape: one compilation for all tests."""
    real = np.arange(ROWS) < len(points)
    rays = rays_to(np.resize(points, (ROWS, 3)).astype(np.float32), SENSOR, hit=real)
    return rays._replace(in_range=jnp.asarray(real))


def scan(window, rays):
    return trace_rays(CONFIG, fuse_hits(CONFIG, window, rays), rays)


def plate_and_wall():
    """Rays to the plate and to the wall beside it, and which end on the plate."""
    plate = sheet(PLATE[0][0], *PLATE, 60)
    wall = sheet(WALL, (0, 0.02, 0.22), (0, 0.98, 0.98), 110)
    wall = wall[~meets_plate(wall, 1e-9)]
    return rays_of(np.concatenate([plate, wall])), jnp.arange(ROWS) < len(plate)


@pytest.fixture(scope="module")
def before():
    """Random passes, none in some voxels; patches in some voxels, with and without passes."""
    rng = np.random.default_rng(1)
    window = fuse_hits(CONFIG, empty_window(), rays_of(uniform(2, 600)))
    passes = rng.integers(1, 6, SHAPE) * (rng.random(SHAPE) < 0.8)
    return window._replace(passes=jnp.asarray(passes, jnp.float32))


@pytest.fixture(scope="module")
def hidden(before):
    """The window with the cloud of the plate and the wall, before and after hiding."""
    rays, fresh = plate_and_wall()
    window = scan(before, rays)
    return window, hide(CONFIG, before, window, rays, fresh)


def sure_of_the_shadow():
    """Voxels that lie in the plate's shadow, and those that are in sight, by geometry."""
    middle = centers()
    depth = np.linalg.norm(middle - SENSOR, axis=-1)
    plate_depth = depth * (PLATE[0][0] - SENSOR[0]) / np.maximum(middle[..., 0] - SENSOR[0], 1e-9)
    beyond = depth - plate_depth
    return (
        meets_plate(middle, -0.03) & (beyond > 0.06),
        ~meets_plate(middle, 0.03) | (beyond < 0.04),
    )


def test_voxels_behind_a_new_surface_are_hidden(before, hidden):
    window, result = hidden
    shadow, clear = sure_of_the_shadow()
    passes = np.asarray(window.passes)
    unmet = (passes == np.asarray(before.passes)) & (window.hits == before.hits)
    known = (np.asarray(before.passes) > 0) | (np.asarray(before.hits) > 0)
    checked = 0
    for cell in map(tuple, np.argwhere(shadow & unmet)):
        expected = -max(passes[cell], 2.0**-8) if known[cell] else passes[cell]
        assert float(result.passes[cell]) == expected
        checked += known[cell]
    assert checked > 25
    np.testing.assert_array_equal(np.asarray(result.passes)[clear], passes[clear])
    assert not np.asarray(is_reached(result.passes, result.hits))[shadow & unmet].any()
    assert np.sum(clear & known) > 300


def test_what_rays_meet_is_never_hidden_and_nothing_but_passes_changes(before, hidden):
    window, result = hidden
    met = np.asarray((window.passes != before.passes) | (window.hits != before.hits))
    passes, after = np.asarray(window.passes), np.asarray(result.passes)
    np.testing.assert_array_equal(after[met], passes[met])
    np.testing.assert_array_equal(after[after >= 0], passes[after >= 0])
    np.testing.assert_array_equal(-after[after < 0], np.maximum(passes[after < 0], 2.0**-8))
    for name in window._fields:
        if name != "passes":
            np.testing.assert_array_equal(getattr(result, name), getattr(window, name), name)


def test_old_surfaces_hide_nothing(before, hidden):
    window, _ = hidden
    rays, fresh = plate_and_wall()
    result = hide(CONFIG, before, window, rays, jnp.zeros_like(fresh))
    np.testing.assert_array_equal(result.passes, window.passes)


def test_hidden_voxels_are_shown_again_when_rays_pass_them(hidden):
    """The plate is gone: all rays reach the wall. What they cannot see stays hidden."""
    _, old = hidden
    rays, none = rays_of(sheet(WALL, (0, 0.02, 0.22), (0, 0.98, 0.98), 125)), jnp.zeros(ROWS, bool)
    window = scan(old, rays)
    result = np.asarray(hide(CONFIG, old, window, rays, none).passes)
    was, passes = np.asarray(old.passes) < 0, np.asarray(window.passes)
    in_sight = was & (centers()[..., 0] < WALL - 0.07)
    assert in_sight.sum() > 25
    assert (result[in_sight] > 0).all()
    unmet = passes == np.asarray(old.passes)
    np.testing.assert_array_equal(
        result[in_sight & unmet], -np.asarray(old.passes)[in_sight & unmet]
    )
    np.testing.assert_array_equal(result[~unmet], passes[~unmet])
    assert (passes[~unmet] > np.abs(np.asarray(old.passes))[~unmet]).all()
    # Voxels of the same shadow, seen by no ray of a cloud that looks elsewhere.
    rays = rays_of(sheet(WALL, (0, 0.02, 0.22), (0, 0.2, 0.98), 60))
    result = np.asarray(hide(CONFIG, old, scan(old, rays), rays, none).passes)
    deep = was & (centers()[..., 1] > 0.5)
    assert deep.sum() > 15
    np.testing.assert_array_equal(result[deep], np.asarray(old.passes)[deep])


CELL = (6, 5, 4)
MIDDLE = np.array([0.35, 0.55, 0.65])  # its center


def found_in(novel, may_join=False, near_new=False):
    """What the comparison found of a consistent cloud: masks of its rows, or one value for all."""

    def rows(mask):
        return jnp.broadcast_to(jnp.asarray(mask, bool), ROWS)

    return Novelty(
        novel=rows(novel),
        may_join=rows(may_join),
        near_new=rows(near_new),
        consistent=jnp.asarray(True),
        noise=jnp.asarray(False),
    )


def add_to_free_space(ends, found, change=0):
    """Fuses returns in space that rays have passed; the window and the mask of fresh rays."""
    rays, start = rays_of(ends), empty_window()
    start = start._replace(
        passes=jnp.full_like(start.passes, 40.0), change=start.change.at[CELL].set(change)
    )
    return add_new(CONFIG, start, fuse_hits(CONFIG, start, rays), rays, found)


def neighbor(offset):
    """The voxel at an offset, m, from `CELL`."""
    return tuple(np.add(CELL, np.round(np.array(offset) / 0.1).astype(int)))


def renew(count, near_new=False, novel=True, passes=40.0, hits=0.0, change=0, beside=0):
    """Fuses some returns in one voxel, and rays that pass it; what becomes of the voxel."""
    start = empty_window()
    start = start._replace(
        passes=start.passes.at[CELL].set(passes),
        hits=start.hits.at[CELL].set(hits),
        change=start.change.at[CELL].set(change),
    )
    rng = np.random.default_rng(3)
    ends = MIDDLE + rng.uniform(-0.02, 0.02, (count, 3))
    past = np.array([0.85, 0.56, 0.66]) + rng.uniform(-0.02, 0.02, (beside, 3))
    ended = np.arange(ROWS) < count
    rays = rays_of(np.concatenate([ends, past, np.full((1, 3), 0.35)]))
    rays = rays._replace(in_range=jnp.arange(ROWS) < count + beside, ends=jnp.asarray(ended))
    window = fused = fuse_hits(CONFIG, start, rays)
    new = float(beside)
    moved = jnp.abs(window.passes[CELL]) + new if beside else window.passes[CELL]
    window = window._replace(passes=window.passes.at[CELL].set(moved))
    found = found_in(ended & novel, may_join=ended, near_new=ended & near_new)
    result, fresh = add_new(CONFIG, start, window, rays, found)
    others = np.ones(SHAPE, bool)
    others[CELL] = False
    for name in ("hits", "passes", "change"):
        known = np.asarray(getattr(fused, name))
        np.testing.assert_array_equal(np.asarray(getattr(result, name))[others], known[others])
    assert np.asarray(fresh).sum() in (0, count)
    cell = (float(result.hits[CELL]), float(result.passes[CELL]), int(result.change[CELL]))
    return *cell, bool(np.asarray(fresh).any())


def test_three_novel_returns_are_a_new_surface_and_forget_old_passes():
    assert renew(3) == (3, 0, 8, True)
    assert renew(20) == (20, 0, 8, True)
    assert renew(2) == (2, 40, 0, False)
    assert renew(3, novel=False) == (3, 40, 0, False)
    assert renew(3, passes=-40.0) == (3, 0, 8, True)


def test_beside_a_new_surface_one_novel_return_will_do():
    assert renew(1, near_new=True) == (1, 0, 8, True)
    assert renew(1, near_new=True, novel=False) == (1, 40, 0, False)


def test_rays_of_the_same_cloud_may_pass_beside_a_new_surface_but_not_too_many():
    assert renew(4, beside=12) == (4, 12, 8, True)
    assert renew(4, beside=13) == (4, 53, 0, False)


def test_a_surface_is_new_for_eight_scans_that_see_it():
    for change in range(8, 0, -1):
        *_, after, fresh = renew(5, novel=False, change=change)
        assert after == change - 1
        assert fresh == (after > 0)
    assert renew(0, change=5) == (0, 40, 5, False)
    assert renew(5, novel=False, change=-2)[2] == -2


def test_returns_in_hidden_space_are_newer_evidence_than_old_passes():
    assert renew(1, passes=-40.0, novel=False) == (1, 0, 0, False)
    assert renew(1, passes=-40.0, hits=6.0, novel=False) == (7, 40, 0, False)  # an old surface
    assert renew(0, passes=-40.0) == (0, -40, 0, False)


@pytest.mark.parametrize(
    ("offset", "new"), [((0, 0, 0.1), True), ((-0.1, 0.1, 0), True), ((0, 0.2, 0), False)]
)
def test_a_single_novel_return_joins_a_surface_that_the_same_cloud_shows(offset, new):
    ends = MIDDLE + np.concatenate([np.zeros((3, 3)), [offset]])
    ended = np.arange(ROWS) < len(ends)
    result, fresh = add_to_free_space(ends, found_in(ended))
    assert float(result.passes[CELL]) == 0
    assert float(result.passes[neighbor(offset)]) == (0 if new else 40)
    assert np.asarray(fresh).sum() == (4 if new else 3)


@pytest.mark.parametrize(
    ("offset", "count", "joins", "hides"),
    [
        ((0, 0, -0.1), 3, True, True),
        ((0, 0, -0.1), 1, True, True),
        ((0, 0, -0.1), 3, False, False),
        ((0, 0, -0.2), 3, True, False),
    ],
)
def test_returns_near_the_floor_hide_space_beside_a_new_surface(offset, count, joins, hides):
    ends = MIDDLE + np.concatenate([np.zeros((3, 3)), np.tile(offset, (count, 1))])
    ended, lower = np.arange(ROWS) < len(ends), np.arange(ROWS) >= 3
    may_join = ended & (joins | ~lower)
    result, fresh = add_to_free_space(ends, found_in(ended & ~lower, may_join))
    other = neighbor(offset)
    assert float(result.passes[CELL]) == 0
    assert float(result.passes[other]) == 40
    assert int(result.change[other]) == 0
    assert np.asarray(fresh).sum() == 3 + hides * count
    # Also while the surface next to it is still new, in a later scan.
    _, fresh = add_to_free_space(ends, found_in(False, may_join), change=5)
    assert np.asarray(fresh).sum() == 3 + hides * count
