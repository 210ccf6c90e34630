"""The evidence of a grid in another frame against float64 loops, and what must never be lost."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from scipy.spatial.transform import Rotation
from voxels import BOUNDS, CONFIG, SHAPE, empty_window, fade_evidence, fuse, trace, uniform

from hiosdf_jax._src.grid import evidence, patches
from hiosdf_jax._src.mapping.joining import rebinning
from hiosdf_jax._src.numerics.shifts import with_neighbors

TARGET = dataclasses.replace(CONFIG, bounds=((-1.3, -1.4, -1.1), (1.5, 1.6, 2.0)))
rebin = jax.jit(rebinning.rebin, static_argnums=(0, 2))
passes_at = jax.jit(rebinning.passes_at, static_argnums=(0, 2))
coincides = jax.jit(rebinning.coincides, static_argnums=0)
is_feature = jax.jit(patches.is_feature, static_argnums=0)
is_doubtful = jax.jit(patches.is_doubtful)


def rigid(rotation, shift):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift
    return pose


POSE = rigid(Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), (0.11, -0.23, 0.35))


@pytest.fixture(scope="module")
def stored():
    """Evidence of walls, stray hits and free space, as a map stores it."""
    window, sensor = empty_window(), np.array([0.31, 0.52, 0.63])
    for seed in range(6):
        wall = uniform(seed, 900, (0.72, 0.1, 0.3), (0.74, 0.9, 0.9))
        low = 700 if seed < 4 else 897  # then only a few rays meet something nearer
        wall[low:] = uniform(20 + seed, 900 - low, (0.0, 0.1, 0.3), (0.5, 0.9, 0.9))
        window = trace(fuse(window, wall, sensor), wall, sensor)
    rng = np.random.default_rng(0)
    hidden = (rng.random(SHAPE) < 0.1) & (np.asarray(window.passes) > 0)
    window = window._replace(
        passes=jnp.where(hidden, -window.passes, window.passes),
        change=jnp.asarray(rng.integers(-60, 9, SHAPE), jnp.int8),
    )
    return evidence.write_window(
        evidence.empty_grid(CONFIG).evidence, fade_evidence(CONFIG, window)
    )


def moved(stored, pose, target=TARGET):
    window = rebin(CONFIG, stored, target, jnp.asarray(pose, jnp.float32))
    return evidence.write_window(evidence.empty_grid(target).evidence, window)


def features(config, known):
    hits, passes, root_weight = (
        np.asarray(x, np.float32) for x in (known.hits, known.passes, known.root_weight)
    )
    return np.asarray(is_feature(config, hits, passes, root_weight**2, known.axes))


@pytest.mark.parametrize("turn", [None, [0, 0, np.pi / 2], [np.pi / 2, 0, 0], [0, np.pi, 0]])
def test_whole_voxels_and_quarter_turns_only_index_anew(stored, turn):
    rotation = np.eye(3) if turn is None else Rotation.from_rotvec(turn).as_matrix()
    pose = rigid(np.round(rotation), (0.3, -0.2, 0.4))
    after = moved(stored, pose)
    index = np.indices(SHAPE).reshape(3, -1).T
    center = index + CONFIG.corner_index + 0.5
    there = np.floor(center @ pose[:3, :3].T + 10 * pose[:3, 3] + 1e-6).astype(int)
    there = tuple((there - TARGET.corner_index).T)
    for name in ("hits", "passes", "behind", "root_weight", "change"):
        old = np.asarray(getattr(stored, name)).reshape(len(index))
        if name == "change":  # what a voxel without a ray remembers does not matter
            known = np.asarray(stored.hits).ravel() > 0
            np.testing.assert_array_equal(np.asarray(after.change)[there][known], old[known])
            continue
        np.testing.assert_array_equal(np.asarray(getattr(after, name))[there], old)
    patch = np.asarray(stored.hits).ravel() > 0
    mean = np.asarray(stored.mean, float).reshape(-1, 3) @ pose[:3, :3].T
    np.testing.assert_allclose(np.asarray(after.mean)[there][patch], mean[patch], atol=1e-3)
    axes = np.asarray(stored.axes, float).reshape(-1, 3, 3) @ pose[:3, :3].T
    np.testing.assert_allclose(np.asarray(after.axes)[there][patch], axes[patch], atol=1e-3)
    if turn is None:
        np.testing.assert_array_equal(
            np.asarray(after.axes)[there][patch],
            np.asarray(stored.axes).reshape(-1, 3, 3)[patch],
        )
    assert np.asarray(after.hits, float).sum() == np.asarray(stored.hits, float).sum()


def slow_patches(known, pose):
    """Patches by voxel of the new grid, in float64: (level, hits, passes, weight, mean, axes)."""
    hits, passes = (np.asarray(x, float) for x in (known.hits, known.passes))
    sure = features(CONFIG, known)
    maybe = np.asarray(is_doubtful(hits.astype(np.float32), passes.astype(np.float32)))
    found = {}
    for cell in np.argwhere(hits > 0):
        at = tuple(cell)
        level = 3 if sure[at] else 2 if maybe[at] else 1
        mean = cell + CONFIG.corner_index + 0.5 + np.asarray(known.mean[at], float)
        mean = pose[:3, :3] @ mean + 10 * pose[:3, 3]
        axes = np.asarray(known.axes[at], float) @ pose[:3, :3].T
        voxel = np.floor(mean).astype(int)
        weight = float(known.root_weight[at]) ** 2
        patch = (level, hits[at], abs(passes[at]), weight, mean - voxel - 0.5, axes)
        found.setdefault(tuple(voxel - TARGET.corner_index), []).append(patch)
    return found


def test_patches_that_meet_are_the_moments_of_all(stored):
    after, expected = moved(stored, POSE), slow_patches(stored, POSE)
    joined = 0
    for voxel, found in expected.items():
        best = max(level for level, *_ in found)
        found = [patch for patch in found if patch[0] == best]
        _, hits, passes, weight, means, axes = map(np.array, zip(*found, strict=True))
        count = hits.sum() if best == 3 else hits.max()
        near_border = np.abs(np.abs(means) - 0.5).min() < 2e-3  # rounding decides there
        if near_border or hits.sum() + passes.sum() > 90:  # and there evidence fades
            continue
        joined += len(found) > 1
        np.testing.assert_allclose(after.hits[voxel], count, rtol=2e-3)
        np.testing.assert_allclose(float(after.root_weight[voxel]) ** 2, weight.sum(), rtol=4e-3)
        share = weight / weight.sum()
        mean = share @ means
        np.testing.assert_allclose(after.mean[voxel], mean, atol=2e-3)
        apart = means - mean
        spread = np.einsum("n,nki,nkj->ij", share, axes, axes)
        spread += np.einsum("n,ni,nj->ij", share, apart, apart)
        new = np.asarray(after.axes[voxel], float)
        np.testing.assert_allclose(new.T @ new, spread, atol=2e-3)
        assert new[2] @ (share @ axes[:, 2]) >= -1e-4
    assert joined > 20


def test_every_surface_is_surface_after_it_has_moved(stored):
    """Rays beside it that met other voxels must not carve it."""
    surface = features(TARGET, moved(stored, POSE))
    expected = [voxel for voxel, found in slow_patches(stored, POSE).items() if found[0][0] == 3]
    assert len(expected) > 50
    assert np.mean([surface[voxel] for voxel in expected]) > 0.98  # the rest are on borders
    near = np.asarray(with_neighbors(jnp.asarray(surface)))
    assert all(near[voxel] for voxel in expected)


def test_stray_hits_that_meet_are_no_surface(stored):
    strict = dataclasses.replace(CONFIG, min_hits=2)
    target = dataclasses.replace(TARGET, min_hits=2)
    hits = jnp.minimum(stored.hits, 1)
    single = stored.replace(hits=hits, passes=jnp.zeros_like(stored.passes))
    window = rebin(strict, single, target, jnp.asarray(POSE, jnp.float32))
    assert float(window.hits.max()) == 1
    counts = window.hits, window.passes, window.weight
    assert not np.asarray(is_feature(target, *counts, window.axes)).any()


def test_a_voxel_is_seen_only_where_all_voxels_that_it_overlaps_are(stored):
    after = moved(stored, POSE)
    passes, hits = (np.asarray(x, float) for x in (stored.passes, stored.hits))
    seen = np.asarray(evidence.is_reached(jnp.asarray(passes), jnp.asarray(hits)))
    new_passes, new_hits = (np.asarray(x, float) for x in (after.passes, after.hits))
    back = np.linalg.inv(POSE)
    line = np.linspace(-0.44, 0.44, 7)
    parts = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    for voxel in np.argwhere((new_hits == 0) & (new_passes > 0)):
        points = voxel + TARGET.corner_index + 0.5 + parts
        cells = np.floor(points @ back[:3, :3].T + 10 * back[:3, 3]).astype(int)
        cells -= np.array(CONFIG.corner_index)
        assert np.all((cells >= 0) & (cells < SHAPE))
        assert seen[tuple(cells.T)].all()
        found = np.where(hits > 0, np.where(passes > 0, passes, 0.004), passes)[tuple(cells.T)]
        assert new_passes[tuple(voxel)] <= found.min() * 1.001
    shrunk = (new_passes > 0).sum() / (passes > 0).sum()
    assert 0.3 < shrunk < 1


def test_what_leaves_the_box_is_lost_and_harms_nothing(stored):
    far = rigid(np.eye(3), (50.0, 0, 0))
    assert arrays_equal(moved(stored, far), evidence.empty_grid(TARGET).evidence)
    half = moved(stored, rigid(np.eye(3), (1.0, 0, 0)))
    kept = np.asarray(stored.hits, float)[:8].sum()
    assert 0 < kept == np.asarray(half.hits, float).sum()
    assert BOUNDS[1][0] + 1.0 > TARGET.bounds[1][0]


def test_passes_are_looked_up_in_the_voxel_that_holds_the_point(stored):
    offset = uniform(5, int(np.prod(TARGET.grid_shape)), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    offset = np.asarray(offset).reshape(*TARGET.grid_shape, 3)
    pose = jnp.asarray(POSE, jnp.float32)
    found = np.asarray(passes_at(CONFIG, stored, TARGET, pose, offset))
    back, passes = np.linalg.inv(POSE), np.abs(np.asarray(stored.passes, float))
    points = np.argwhere(np.ones(TARGET.grid_shape)) + TARGET.corner_index + 0.5
    points = (points + offset.reshape(-1, 3)) @ back[:3, :3].T + 10 * back[:3, 3]
    cells = np.floor(points).astype(int) - np.array(CONFIG.corner_index)
    inside = ((cells >= 0) & (cells < SHAPE)).all(axis=1)
    expected = np.where(inside, passes[tuple(np.where(inside[:, None], cells, 0).T)], 0)
    near_border = np.abs(points - np.round(points)).min(axis=1) < 1e-4
    np.testing.assert_array_equal(found.ravel()[~near_border], expected[~near_border])
    assert (expected > 0).sum() > 100


@pytest.mark.parametrize(
    ("turn", "shift", "expected"),
    [
        ((0, 0, 0), (0.3, -0.2, 0.4), True),
        ((0, 0, np.pi / 2), (0.0, 12.1, 0.0), True),
        ((0, np.pi, 0), (0.0, 0.0, 0.05), False),
        ((0, 0, 0.01), (0.0, 0.0, 0.0), False),
    ],
)
def test_only_whole_voxels_and_quarter_turns_coincide(turn, shift, expected):
    pose = rigid(Rotation.from_rotvec(turn).as_matrix(), shift)
    assert bool(coincides(TARGET, jnp.asarray(pose, jnp.float32))) == expected
