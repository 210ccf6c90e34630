"""The stages of the coarse grid against slow, obvious references in numpy and scipy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

import hiosdf_jax as hio
from hiosdf_jax._src.grid import (
    carving,
    change,
    distance,
    evidence,
    frontier,
    geometry,
    lookup,
    patches,
)
from hiosdf_jax._src.grid.rays import Beams, place_cloud
from hiosdf_jax._src.numerics import vectors
from hiosdf_jax._src.numerics.rigid import is_rigid
from hiosdf_jax._src.numerics.vectors import join, split
from hiosdf_jax._src.samples import from_grid
from hiosdf_jax._src.samples.draw import draw_from_mask

BOUNDS = ((-0.3, 0.0, 0.2), (0.9, 1.0, 1.0))
CONFIG = hio.Config.light(
    BOUNDS, max_range=3.0, distance_horizon=1.5, near_samples=300, far_samples=500, min_hits=1
)
SHAPE = (12, 10, 8)
FIRST = jnp.zeros(3, jnp.int32)  # the window is the whole grid

# One compilation a stage and configuration, as in an update.
fuse_hits = jax.jit(patches.fuse_hits, static_argnums=0)
trace_rays = jax.jit(carving.trace_rays, static_argnums=0)
fade_evidence = jax.jit(evidence.fade_evidence, static_argnums=0)
update_distances = jax.jit(distance.update_distances, static_argnums=0)
update_frontier = jax.jit(frontier.update_frontier, static_argnums=0)


def empty_grid(config=CONFIG):
    """As stages see it: what the rays counted in float32."""
    grid = evidence.empty_grid(config)
    counts = {
        name: getattr(grid, name).astype(jnp.float32)
        for name in ("hits", "passes", "behind", "weight")
    }
    return grid.replace(**counts)


def uniform(seed, count, low=BOUNDS[0], high=BOUNDS[1]):
    return np.random.default_rng(seed).uniform(low, high, (count, 3)).astype(np.float32)


def fuse(grid, points, sensor=(0.3, 0.5, 0.6), valid=None, config=CONFIG):
    valid = np.ones(len(points), bool) if valid is None else valid
    return fuse_hits(config, grid, FIRST, jnp.asarray(points), valid, jnp.asarray(sensor))


def everywhere(sensor):
    """The change by a cloud that may have gone anywhere within range."""
    sensor = jnp.asarray(sensor, jnp.float32)
    return change.Change(sensor, sensor - 100, sensor + 100)


def same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


# Geometry


def test_voxels_are_those_of_the_world_lattice():
    points = uniform(0, 500, (-1, -1, -1), (2, 2, 2))
    index, offset, inside = geometry.voxel_of(CONFIG, points)
    lattice = np.floor(points.astype(np.float64) / 0.1) - np.floor(np.array(BOUNDS[0]) / 0.1 + 1e-6)
    expected = np.all((lattice >= 0) & (lattice < SHAPE), axis=1)
    assert CONFIG.grid_shape == SHAPE
    np.testing.assert_array_equal(inside, expected)
    np.testing.assert_array_equal(index[expected], lattice[expected])
    center = geometry.voxel_center(CONFIG, index)
    np.testing.assert_allclose(center + offset * 0.1, points, atol=2e-6)


def test_far_and_missing_points_are_outside():
    points = np.array([[np.nan, 0, 0.5], [1e30, 0.5, 0.5], [0, -3e9, 0.5], [0, 0.5, np.inf]])
    index, _, inside = geometry.voxel_of(CONFIG, jnp.asarray(points, jnp.float32))
    assert not np.asarray(inside).any()
    assert (np.asarray(index) >= 0).all()
    assert (np.asarray(index) < SHAPE).all()


def test_voxel_and_offset_do_not_depend_on_the_bounds():
    larger = dataclasses.replace(CONFIG, bounds=((-2.0, -0.5, -1.0), (0.9, 3.0, 1.0)))
    points = uniform(1, 300)
    shift = np.subtract(CONFIG.corner_index, larger.corner_index)
    index, offset, _ = geometry.voxel_of(CONFIG, points)
    index_larger, offset_larger, _ = geometry.voxel_of(larger, points)
    np.testing.assert_array_equal(index + shift, index_larger)
    np.testing.assert_array_equal(offset, offset_larger)


def test_corners_interpolate_affine_functions_exactly_and_know_the_border():
    points = uniform(2, 300)
    corners = geometry.corners_of(CONFIG, points)
    centers = geometry.voxel_center(CONFIG, join(corners.index))
    between = np.sum(centers * np.asarray(corners.weight)[..., None], axis=-2)
    np.testing.assert_allclose(between, points, atol=1e-6)
    index = np.stack(corners.index, axis=-1)
    inside = np.all((index >= 0) & (index < SHAPE), axis=-1)
    assert 50 < np.sum(~inside.all(axis=1)) < 299
    np.testing.assert_array_equal(corners.inside, inside)
    clipped = np.clip(index, 0, np.array(SHAPE) - 1)
    np.testing.assert_array_equal(
        corners.flat, np.ravel_multi_index(tuple(np.moveaxis(clipped, -1, 0)), SHAPE)
    )


@pytest.mark.parametrize("center", [(0.3, 0.5, 0.6), (-0.29, 0.99, 0.21), (9.0, -9.0, 0.5)])
def test_windows_hold_all_that_is_within_reach(center):
    reach = 0.25
    shape = geometry.window_shape(CONFIG, reach)
    start = np.array(geometry.window_start(CONFIG, shape, jnp.asarray(center)))
    index = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.all(np.abs(geometry.voxel_center(CONFIG, index) - np.array(center)) <= reach, axis=1)
    assert np.all(index[near] >= start)
    assert np.all(index[near] < start + shape)
    assert np.all(start >= 0)
    assert np.all(start + shape <= SHAPE)


# Surface patches


def test_patches_are_the_weighted_moments_of_all_hits():
    sensor = np.array([0.3, 0.5, 0.6])
    clouds = [uniform(k, 900, (0.0, 0.1, 0.3), (0.3, 0.4, 0.5)) for k in range(3)]
    grid = empty_grid()
    for cloud in clouds:
        grid = fuse(grid, cloud, sensor)
    points = np.concatenate(clouds).astype(np.float64)
    a, b = CONFIG.range_noise
    weight = 1 / (1 + b / a * np.sum((points - sensor) ** 2, axis=1)) ** 2
    voxel = np.floor(points / 0.1 + 1e-9).astype(int) - CONFIG.corner_index
    checked = 0
    for cell in np.unique(voxel, axis=0):
        here = np.all(voxel == cell, axis=1)
        w = weight[here]
        center = (cell + CONFIG.corner_index + 0.5) * 0.1
        offset = (points[here] - center) / 0.1
        mean = w @ offset / w.sum()
        spread = (w[:, None] * (offset - mean)).T @ (offset - mean) / w.sum()
        at = tuple(cell)
        if here.sum() < 20:
            continue
        checked += 1
        assert float(grid.hits[at]) == here.sum()
        np.testing.assert_allclose(grid.weight[at], w.sum(), rtol=1e-4)
        np.testing.assert_allclose(grid.surface.mean[at], mean, atol=2e-3)  # float16
        axes = np.asarray(grid.surface.axes[at], np.float64)
        np.testing.assert_allclose(axes.T @ axes, spread, atol=1e-3)
        lengths = np.linalg.norm(axes, axis=1)
        assert lengths[0] >= lengths[1] >= lengths[2]
        normal = axes[2]
        assert normal @ ((sensor - center) / 0.1 - mean) >= -1e-3
    assert checked >= 12


@pytest.mark.parametrize("hits", [1, 2])
def test_the_normal_of_too_few_hits_is_towards_the_sensor(hits):
    """Not what rounding makes of it: it tells the side of voxels that no ray has met."""
    rng = np.random.default_rng(12)
    sensor = np.array([2.0, -1.5, 1.7])
    cells = np.argwhere(rng.random(SHAPE) < 0.3)
    centers = (cells + CONFIG.corner_index + 0.5) * 0.1
    points = centers[:, None] + rng.uniform(-0.04, 0.04, (len(cells), hits, 3))
    grid = fuse(empty_grid(), points.reshape(-1, 3).astype(np.float32), sensor)
    axes = np.asarray(grid.surface.axes, np.float64)[tuple(cells.T)]
    offsets = (points - centers[:, None]) / 0.1
    a, b = CONFIG.range_noise
    weight = 1 / (1 + b / a * np.sum((points - sensor) ** 2, axis=-1, keepdims=True)) ** 2
    mean = np.sum(weight * offsets, axis=1) / np.sum(weight, axis=1)
    expected = (sensor - centers) / 0.1 - mean
    if hits == 2:
        line = offsets[:, 1] - offsets[:, 0]
        line /= np.linalg.norm(line, axis=1)[:, None]
        expected -= np.sum(expected * line, axis=1)[:, None] * line
        assert np.abs(np.sum(axes[:, 1] * line, axis=1)).max() < 1e-5
        assert np.abs(np.sum(axes[:, 1] * axes[:, 2], axis=1)).max() < 1e-8
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    assert len(cells) > 200
    np.testing.assert_allclose(axes[:, 2], 1e-3 * expected, atol=5e-6)


def test_invalid_rows_and_points_outside_change_nothing():
    points = uniform(4, 50)
    padded = np.concatenate([points, uniform(5, 30), np.full((20, 3), 7.0, np.float32)])
    valid = np.arange(100) < 50
    valid[80:] = True  # these are outside
    assert same(fuse(empty_grid(), points), fuse(empty_grid(), padded, valid=valid))


def test_the_order_of_rows_does_not_matter():
    points = uniform(6, 400, (0.0, 0.1, 0.3), (0.3, 0.4, 0.5))
    a, b = fuse(empty_grid(), points), fuse(empty_grid(), points[::-1].copy())
    np.testing.assert_array_equal(a.hits, b.hits)
    np.testing.assert_allclose(a.surface.mean, b.surface.mean, atol=1e-3)
    spread = [
        jnp.einsum("...ki,...kj->...ij", g.surface.axes, g.surface.axes).astype(np.float32)
        for g in (a, b)
    ]
    np.testing.assert_allclose(*spread, atol=1e-3)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 3))
def test_principal_axes_against_numpy(seed, rank):
    factor = np.random.default_rng(seed).normal(size=(3, rank))
    spread = (factor @ factor.T).astype(np.float32)
    deviation, direction = patches.principal_axes(jnp.asarray(spread))
    expected = np.sqrt(np.maximum(np.linalg.eigvalsh(spread.astype(np.float64))[::-1], 0))
    scale = max(1.0, expected[0])
    np.testing.assert_allclose(np.square(deviation), np.square(expected), atol=2e-6 * scale**2)
    np.testing.assert_allclose(direction @ direction.T, np.eye(3), atol=1e-5)
    rebuilt = direction.T @ np.diag(np.square(deviation)) @ direction
    np.testing.assert_allclose(rebuilt, spread, atol=5e-6 * scale**2)


def test_vectors_of_three_arrays():
    rng = np.random.default_rng(0)
    table, rows = rng.normal(size=(40, 9)).astype(np.float16), rng.integers(40, size=(5, 2))
    taken = vectors.take(jnp.asarray(table), jnp.asarray(rows, jnp.int32), 3)
    np.testing.assert_array_equal(join(taken), table[rows, 3:6].astype(np.float32))
    jumps = vectors.take(jnp.asarray([[-128, 0, 127]], jnp.int8), jnp.zeros(2, jnp.int32))
    np.testing.assert_array_equal(join(jumps), [[-128, 0, 127]] * 2)
    a, b = (rng.normal(size=(6, 3)).astype(np.float32) for _ in range(2))
    np.testing.assert_allclose(vectors.dot(split(a), split(b)), np.sum(a * b, axis=1), rtol=1e-5)
    a[0] = 0
    sizes, pull = jax.vjp(lambda v: vectors.length(split(v)), jnp.asarray(a))
    exact = np.linalg.norm(a, axis=1)
    np.testing.assert_allclose(sizes, exact, rtol=1e-6)
    np.testing.assert_allclose(
        pull(jnp.ones(6))[0], a / np.where(exact > 0, exact, 1)[:, None], rtol=1e-5
    )


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([(0.3, 0.2), (0.3, 0.0), (0.0, 0.0)]))
def test_patch_offset_against_a_dense_rectangle(seed, half):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    scale = 0.9 * 3**0.5
    axes = rotation * np.array([*half, 0.01])[:, None]
    mean, point = rng.uniform(-0.5, 0.5, 3), rng.uniform(-2, 2, 3)
    u = np.linspace(-1, 1, 401)
    rectangle = mean + scale * (u[:, None, None] * axes[0] + u[None, :, None] * axes[1]).reshape(
        -1, 3
    )
    nearest = np.linalg.norm(rectangle - point, axis=1).min()
    point32, mean32, first, second = (
        split(jnp.asarray(x, jnp.float32)) for x in (point, mean, axes[0], axes[1])
    )
    offset = patches.patch_offset(point32, mean32, (first, second))
    np.testing.assert_allclose(np.linalg.norm(offset), nearest, atol=1e-4)


# Rays


def trace(grid, ends, sensor, hit=True, config=CONFIG):
    return trace_rays(config, grid, FIRST, beams_to(ends, sensor, hit))


def beams_to(ends, sensor, hit=True):
    ends, sensor = np.asarray(ends, np.float32), np.asarray(sensor, np.float32)
    ranges = np.linalg.norm(ends - sensor, axis=1)
    every = np.ones(len(ends), bool)
    return Beams(
        points_world=jnp.asarray(ends),
        directions_world=jnp.asarray((ends - sensor) / ranges[:, None]),
        free_ranges=jnp.asarray(ranges),
        in_range=every,
        ends=every & hit,
        inside=every,
        sensor_world=jnp.asarray(sensor),
    )


@pytest.mark.parametrize("hit", [True, False])
def test_rays_against_a_loop(hit):
    sensor = np.array([0.31, 0.52, 0.63])
    ends = uniform(7, 40, (-0.8, -0.4, 0.0), (1.4, 1.4, 1.2)).astype(np.float64)
    grid = trace(empty_grid(), ends, sensor, hit)
    passes, behind = np.zeros(SHAPE), np.zeros(SHAPE)
    phases = np.asarray(carving._phases(40), np.float64)
    for end, phase in zip(ends, phases, strict=True):
        length = np.linalg.norm(end - sensor) / 0.1
        direction = (end - sensor) / length
        steps = [k + phase for k in range(100) if k + phase < length - (1 if hit else 0)]
        hidden = [length + 0.5 + k + phase for k in range(3)] if hit else []
        for array, along in ((passes, steps), (behind, hidden)):
            for t in along:
                cell = np.floor((sensor + t * direction) / 0.1).astype(int) - CONFIG.corner_index
                if np.all((cell >= 0) & (cell < SHAPE)):
                    array[tuple(cell)] += 1
    # A step that falls on a face of a voxel may be rounded to either side.
    assert np.abs(np.asarray(grid.passes) - passes).sum() <= 4
    assert np.abs(np.asarray(grid.behind) - behind).sum() <= 2
    assert passes.sum() > 100


def test_long_rays_go_on_from_step_to_step_of_the_loop(monkeypatch):
    ends, sensor = uniform(7, 40, (0.1, 0.1, 0.3), (0.9, 0.9, 0.9)), np.array([0.0, 0.0, 0.25])
    config = dataclasses.replace(CONFIG, voxel_size=0.02)
    beams = beams_to(ends, sensor)
    assert np.max(beams.free_ranges) / 0.02 > 60
    once = carving.trace_rays(config, empty_grid(config), FIRST, beams)
    for chunk in (5, 100):
        monkeypatch.setattr(carving, "_CHUNK", chunk)
        again = carving.trace_rays(config, empty_grid(config), FIRST, beams)
        np.testing.assert_array_equal(again.passes, once.passes)
    longest = np.sum(np.asarray(beams.free_ranges) / 0.02 - 1)
    assert abs(float(once.passes.sum()) - longest) < len(ends)


@pytest.mark.parametrize("sensor", [(0.31, 0.52, 0.63), (0.95, 0.95, 0.15), (1.0, 0.5, 0.6)])
def test_the_window_around_the_sensor_is_all_that_a_cloud_changes(sensor):
    config = dataclasses.replace(CONFIG, max_range=0.15, voxel_size=0.05, min_range=0.0)
    rng = np.random.default_rng(11)
    away = rng.normal(size=(300, 3))
    reach = rng.uniform(0.05, 0.15, (300, 1))
    ends = (np.array(sensor) + reach * away / np.linalg.norm(away, axis=1)[:, None]).astype(
        np.float32
    )
    whole, parts, sizes = empty_grid(config), evidence.empty_grid(config), set()
    for _ in range(3):
        whole = trace(fuse(whole, ends, sensor, config=config), ends, sensor, config=config)
        whole = fade_evidence(config, whole)
        start, window = evidence.read_evidence(config, parts, jnp.asarray(sensor, jnp.float32))
        sizes.add(window.hits.shape)
        window = fuse_hits(config, window, start, ends, np.ones(300, bool), jnp.asarray(sensor))
        window = trace_rays(config, window, start, beams_to(ends, sensor))
        parts = evidence.write_evidence(parts, start, fade_evidence(config, window))
    assert all(part < all_of for part, all_of in zip(*sizes, whole.hits.shape, strict=True))
    assert np.sum(np.asarray(whole.hits)) > 30
    for name in ("hits", "passes", "behind"):
        stored = np.asarray(getattr(whole, name), np.float16)
        np.testing.assert_array_equal(getattr(parts, name), stored)
    np.testing.assert_allclose(
        np.asarray(parts.weight, np.float32) ** 2, whole.weight, rtol=4e-3, atol=1e-6
    )
    np.testing.assert_allclose(parts.surface.mean, whole.surface.mean, atol=3e-3)


def test_evidence_fades_only_where_rays_come_by():
    rng = np.random.default_rng(3)
    share = rng.random(SHAPE)
    rays_of = CONFIG.evidence_limit * rng.uniform(0.998, 1.002, SHAPE)
    grid = evidence.empty_grid(CONFIG).replace(hits=share * rays_of, passes=(1 - share) * rays_of)
    start = np.zeros(3, np.int32)
    stored = [evidence.empty_grid(CONFIG)]
    for _ in range(3):
        stored.append(evidence.write_evidence(stored[0], start, fade_evidence(CONFIG, grid)))
        grid = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), stored[-1])
    assert not same(stored[1].hits, stored[0].hits)
    assert same(stored[2], stored[1]) and same(stored[3], stored[1])


def test_fading_against_its_definition():
    rng = np.random.default_rng(4)
    limit = CONFIG.evidence_limit
    hits, passes, behind = (limit * rng.uniform(0, 1.5, SHAPE) for _ in range(3))
    weight = rng.uniform(0.1, 5, SHAPE)
    grid = empty_grid().replace(
        hits=jnp.asarray(hits, jnp.float32),
        passes=jnp.asarray(passes, jnp.float32),
        behind=jnp.asarray(behind, jnp.float32),
        weight=jnp.asarray(weight, jnp.float32),
    )
    faded = fade_evidence(CONFIG, grid)
    scale = np.minimum(limit / (hits + passes), 1)
    assert 0.1 < (scale < 1).mean() < 0.9
    for name, exact in (("hits", hits), ("passes", passes), ("weight", weight)):
        # Up to 0.07 % above the limit nothing is scaled.
        np.testing.assert_allclose(getattr(faded, name), scale * exact, rtol=8e-4)
    np.testing.assert_allclose(faded.behind, np.minimum(behind, limit), rtol=1e-6)


def test_a_pose_of_few_digits_takes_no_ray_out_of_reach():
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] *= 1.002
    assert is_rigid(pose, np)
    cloud = np.array([[0, 0, 0.9991], [0, 0.9, 0], [0.999, 0, 0], [5, 0, 0]], np.float32)
    config = dataclasses.replace(CONFIG, max_range=1.0)
    beams = place_cloud(config, jnp.asarray(cloud), np.ones(4, bool), jnp.asarray(pose))
    np.testing.assert_array_equal(beams.ends, [False, True, False, False])
    np.testing.assert_allclose(beams.free_ranges, [1, 0.9018, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(beams.directions_world, axis=1), 1, rtol=1e-6)


def test_a_vanished_wall_is_carved_and_a_new_one_believed():
    sensor = np.array([0.05, 0.55, 0.65])
    near = uniform(8, 300, (0.42, 0.41, 0.51), (0.44, 0.69, 0.79))  # a wall that is removed later
    far = sensor + (near - sensor) * ((0.84 - sensor[0]) / (near[:, :1] - sensor[0]))
    grid, history = empty_grid(), []
    for cloud in [near] * 30 + [far] * 60:
        grid = trace(fuse(grid, cloud, sensor), cloud, sensor)
        grid = fade_evidence(CONFIG, grid)
        features = patches.is_feature(CONFIG, grid.hits, grid.passes, grid.surface.axes)
        history.append((bool(features[7, 5, 4]), bool(features[11, 5, 4])))
    assert float(jnp.max(grid.hits + grid.passes)) <= CONFIG.evidence_limit * 1.001
    assert history[29] == (True, False)
    assert history[31][1]
    gone = next(k for k, (wall, _) in enumerate(history) if not wall and k >= 30)
    # The wall's evidence, at the limit, fades at the rate at which rays pass: within 60 clouds.
    assert 30 <= gone < 60
    assert history[-1] == (False, True)


# Distances


def test_nearest_sites_are_exact_on_the_lattice():
    rng = np.random.default_rng(9)
    for share in (0.001, 0.02, 0.3):
        sites = rng.random((23, 17, 11)) < share
        sites[3, 4, 5] = True
        exact, index = distance_transform_edt(~sites, return_indices=True)
        nearest, squared = distance.nearest_sites(
            jnp.asarray(sites), jnp.zeros((23, 17, 11, 3)), 40
        )
        np.testing.assert_allclose(np.sqrt(squared), exact, atol=1e-5)
        chosen = np.stack(np.unravel_index(np.asarray(nearest), sites.shape))
        here = np.indices(sites.shape)
        np.testing.assert_allclose(np.linalg.norm(chosen - here, axis=0), exact, atol=1e-5)
        assert sites[tuple(chosen)].all()
        assert index.shape == chosen.shape


def test_the_horizon_cuts_off():
    sites = np.zeros((30, 5, 4), bool)
    sites[2, 2, 2] = True
    exact = distance_transform_edt(~sites)
    nearest, _ = distance.nearest_sites(jnp.asarray(sites), jnp.zeros((30, 5, 4, 3)), 9)
    np.testing.assert_array_equal(np.asarray(nearest) >= 0, exact <= 9)
    none, _ = distance.nearest_sites(jnp.zeros((4, 5, 6), bool), jnp.zeros((4, 5, 6, 3)), 9)
    assert (np.asarray(none) == -1).all()


def numpy_passes(sites, offset, horizon, part, order=(2, 1, 0)):
    """The passes in float64: each voxel takes the least of all that lie along the axis."""
    nearest = np.arange(sites.size).reshape(sites.shape)
    squared = np.where(sites, np.sum(offset.astype(np.float64) ** 2, axis=-1), 1e12)
    for axis in order:
        along = offset[..., axis].astype(np.float64).ravel()[nearest]
        across, rows = squared - along**2, np.arange(sites.shape[axis])
        least, chosen = [], []
        for row in range(part.start[axis], part.start[axis] + part.shape[axis]):
            shift = (rows - row).reshape([-1 if k == axis else 1 for k in range(3)])
            candidates = np.where(np.abs(shift) <= horizon + 1, across + (shift + along) ** 2, 1e12)
            best = np.expand_dims(np.argmin(candidates, axis), axis)
            least.append(np.take_along_axis(candidates, best, axis))
            chosen.append(np.take_along_axis(nearest, best, axis))
        squared, nearest = np.concatenate(least, axis), np.concatenate(chosen, axis)
    return np.where(squared <= horizon**2, nearest, -1), squared


@pytest.mark.parametrize("chunk", [1, 8, 100])
@pytest.mark.parametrize(("share", "horizon"), [(0.0005, 9), (0.0005, 16), (0.002, 25), (0.02, 40)])
def test_the_passes_against_numpy(monkeypatch, share, horizon, chunk):
    monkeypatch.setattr(distance, "_CHUNK", chunk)
    rng = np.random.default_rng(11)
    sites = rng.random((40, 21, 13)) < share
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    part = distance.Part((3, 2, 0), (30, 11, 13))
    expected, exact = numpy_passes(sites, offset, horizon, part)
    nearest, squared = distance.nearest_sites(
        jnp.asarray(sites), jnp.asarray(offset), horizon, part
    )
    np.testing.assert_array_equal(nearest, expected)
    found = expected >= 0
    assert found.sum() > 0
    np.testing.assert_allclose(np.asarray(squared)[found], exact[found], rtol=1e-5, atol=1e-5)


def test_nearest_sites_with_offsets_against_a_tree():
    """Off the lattice a pass can prefer a site whose other coordinates are worse: bounded."""
    rng = np.random.default_rng(10)
    sites = rng.random((24, 20, 16)) < 0.02
    offset = rng.uniform(-0.5, 0.5, (*sites.shape, 3)).astype(np.float32)
    _, squared = distance.nearest_sites(jnp.asarray(sites), jnp.asarray(offset), 40)
    cells = np.argwhere(sites)
    tree = cKDTree(cells + offset[sites])
    exact, _ = tree.query(np.indices(sites.shape).reshape(3, -1).T)
    excess = np.sqrt(np.asarray(squared)).ravel() - exact
    assert excess.min() > -1e-4
    assert np.mean(excess > 1e-4) < 0.02
    assert excess.mean() < 0.005
    assert excess.max() < 1


def wall_room(config, seeds=range(4), half=(0.47, 0.38, 0.29), center=(0.3, 0.5, 0.6)):
    """The grid after exact views of a box room from inside."""
    grid = empty_grid(config)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        sensor = np.array(center) + rng.uniform(-0.1, 0.1, 3)
        directions = rng.normal(size=(4000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach = (np.array(half) * np.sign(directions) - (sensor - center)) / directions
        ends = sensor + directions * reach.min(axis=1, keepdims=True)
        grid = trace(
            fuse(grid, ends.astype(np.float32), sensor, config=config), ends, sensor, config=config
        )
        grid = update_distances(config, grid, everywhere(sensor))
    return grid


def test_grid_distance_of_a_room_is_exact_in_value_sign_and_gradient():
    half, center = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
    grid = wall_room(CONFIG)
    points = uniform(11, 2000)
    gaps = half - np.abs(points - center)
    exact = np.where(
        (gaps > 0).all(axis=1), gaps.min(axis=1), -np.linalg.norm(np.minimum(gaps, 0), axis=1)
    )
    value, gradient = lookup.grid_sdf_and_grad(CONFIG, grid.surface, jnp.asarray(points))
    inside = exact > 0
    error = np.asarray(value) - exact
    assert np.abs(error[inside]).mean() < 0.002
    # In the voxels of the room's edges a patch has no side; 2 cm away the sign is certain.
    assert (np.asarray(value)[exact > 0.02] > 0).all()
    assert np.mean(np.asarray(value)[inside] > 0) > 0.95
    shallow = (exact < -0.005) & (exact > -0.1)
    assert shallow.sum() > 50
    assert np.mean(np.asarray(value)[shallow] < 0) > 0.95
    assert np.abs(error[shallow]).mean() < 0.01
    ordered = np.sort(gaps, axis=1)
    plain = inside & (exact > 0.01) & (ordered[:, 1] - ordered[:, 0] > 0.08)
    axis = np.argmin(gaps[plain], axis=1)
    normal = -np.sign(points - center)[plain] * (np.arange(3) == axis[:, None])
    assert np.mean(np.sum(np.asarray(gradient)[plain] * normal, axis=1)) > 0.99
    assert np.isfinite(np.asarray(gradient)).all()
    batch = lookup.grid_sdf(CONFIG, grid.surface, jnp.asarray(points[:20]))
    single = [lookup.grid_sdf(CONFIG, grid.surface, jnp.asarray(p)) for p in points[:20]]
    np.testing.assert_allclose(batch, single, atol=1e-6)


def test_grid_distance_against_brute_force_over_all_patches():
    grid = wall_room(CONFIG, seeds=range(2))
    features = np.asarray(patches.is_feature(CONFIG, grid.hits, grid.passes, grid.surface.axes))
    cells = np.argwhere(features)
    mean = np.asarray(grid.surface.mean, np.float64)[features] + cells + CONFIG.corner_index + 0.5
    axes = np.asarray(grid.surface.axes, np.float64)[features]
    points = uniform(12, 400).astype(np.float64)
    # float64 again, from the definition of a patch
    offset = points[:, None] / 0.1 - mean
    for k in range(2):
        half = 0.9 * 3**0.5 * axes[:, k]
        along = np.clip((offset * half).sum(-1) / np.maximum((half**2).sum(-1), 1e-12), -1, 1)
        offset = offset - along[..., None] * half
    exact = 0.1 * np.linalg.norm(offset, axis=-1).min(axis=1)
    value = np.abs(lookup.grid_sdf(CONFIG, grid.surface, jnp.asarray(points, jnp.float32)))
    assert (value - exact).min() > -1e-4
    assert np.mean(value - exact > 1e-4) < 0.02
    assert (value - exact).max() < 0.01


def test_a_sheet_seen_from_both_sides_is_free_on_both():
    grid = empty_grid()
    for side in (-1, 1):
        sensor = np.array([0.3 + side * 0.4, 0.5, 0.6])
        ends = uniform(13, 3000, (0.36, 0.1, 0.3), (0.36001, 0.9, 0.9))
        grid = trace(fuse(grid, ends, sensor), ends, sensor)
    grid = update_distances(CONFIG, grid, everywhere((0.3, 0.5, 0.6)))
    points = uniform(14, 300, (0.2, 0.3, 0.45), (0.52, 0.7, 0.75))
    value = np.asarray(lookup.grid_sdf(CONFIG, grid.surface, points))
    assert np.mean(value >= 0) > 0.99
    # Patches leave narrow gaps between each other: exact in the mean, within 1 cm everywhere.
    error = value - np.abs(points[:, 0] - 0.36)
    assert np.abs(error).mean() < 5e-4
    assert np.abs(error).max() < 0.01


@pytest.mark.parametrize(
    ("voxel", "max_range", "horizons", "box", "axis", "shapes"),
    [
        (0.1, 0.5, (0.6, 0.4), (6.0, 1.0, 1.0), 0, [41, 47]),
        # 2 + 0.8 + 0.4 + 0.2 + 0.4 m is, rounded, not more than 19 voxels of 0.2 m.
        (0.2, 2.0, (0.4, 0.4), (24.0, 4.0, 4.0), 0, [31, 41]),
        # The two long axes tie in the small window, and not in the grid.
        (0.1, 0.5, (0.6, 0.4), (6.0, 4.5, 1.0), 0, [41, 47]),
        (0.1, 0.5, (0.6, 0.4), (1.0, 6.0, 1.0), 1, [41, 47]),
    ],
)
def test_a_window_gives_what_a_full_recomputation_gives(
    voxel, max_range, horizons, box, axis, shapes
):
    scale = max_range / 0.5
    small = dataclasses.replace(
        CONFIG,
        voxel_size=voxel,
        bounds=((0.0, 0.0, 0.0), box),
        max_range=max_range,
        distance_horizon=horizons[0],
        frontier_horizon=horizons[1],
    )
    large = dataclasses.replace(small, max_range=100.0)
    grids, fits = [empty_grid(small), empty_grid(large), empty_grid(small)], set()
    for x, spread in ((0.5, 0.2), (2.0, 0.25), (3.3, 0.35), (2.2, 0.1), (0.9, 0.15)):
        sensor = np.array(box) / 2
        sensor[axis] = scale * x
        ends = sensor + scale * uniform(int(10 * x), 60, (-spread,) * 3, (spread,) * 3)
        # Some look one way; none reaches farther than the range.
        ends[:, axis] += scale * (spread + 0.05 if spread <= 0.2 else 0.1)
        ends = ends.astype(np.float32)
        cloud = change.change_by(beams_to(ends, sensor))
        half, whole, fit = change.place_windows(small, cloud, horizons[0])
        assert [half.shape[axis], whole.shape[axis]] == shapes
        fits.add(bool(fit))
        changes = (everywhere(sensor), everywhere(sensor), cloud)
        for k, config in enumerate((small, large, small)):
            grid = fuse(grids[k], ends, sensor, config=config)
            grid = trace(grid, ends, sensor, config=config)
            grid = update_distances(config, grid, changes[k])
            grids[k] = update_frontier(config, grid, changes[k])
    assert fits == {True, False}
    assert max(shapes) < small.grid_shape[axis]
    assert same(grids[0].surface, grids[1].surface)
    assert same(grids[2].surface, grids[1].surface)


def test_the_small_window_is_for_rays_that_reach_half_the_range_along_no_axis():
    sensor = np.array([0.23, 0.51, 0.62])
    config = dataclasses.replace(CONFIG, bounds=((-3,) * 3, (3,) * 3), max_range=1.0)
    for axis in range(3):
        for reach, fits in ((0.9, True), (1.1, False)):
            ends = np.tile(sensor, (5, 1)) + 0.01
            ends[:, axis] += np.linspace(0.5, reach, 5)  # the sensor is outside the ends' box
            cloud = change.change_by(beams_to(ends, sensor))
            np.testing.assert_allclose(cloud.low_world, sensor, atol=1e-6)
            small, large, fit = change.place_windows(config, cloud, 0.3)
            assert bool(fit) is fits
            window = small if fits else large
            first, size = np.array(window.inner_start), np.array(window.inner_shape)
            # All that lies within the horizon of the rays and of what they hide can change.
            reach = 0.3 + 0.1 * carving.HIDDEN_VOXELS
            assert (3 + cloud.low_world - reach >= 0.1 * first - 1e-6).all()
            assert (3 + cloud.high_world + reach <= 0.1 * (first + size) + 1e-6).all()
            assert (np.array(window.within) >= 3).all()
            assert (np.add(window.within, size) + 3 <= window.shape).all()


def test_an_empty_grid_answers_the_horizon():
    value, gradient = lookup.grid_sdf_and_grad(CONFIG, empty_grid().surface, uniform(15, 20))
    np.testing.assert_array_equal(value, np.full(20, 1.5, np.float32))
    assert np.isfinite(np.asarray(gradient)).all()


# Samples


def test_samples_are_near_and_far_and_carry_the_grids_distance():
    grid = wall_room(CONFIG, seeds=range(2))
    samples = from_grid.sample_grid(CONFIG, grid, jax.random.key(0))
    assert samples.points_world.shape == (800, 3)
    assert np.asarray(samples.weight).all()
    index, _, inside = geometry.voxel_of(CONFIG, samples.points_world)
    assert np.asarray(inside).all()
    at_center = np.abs(np.asarray(grid.surface.sdf)[tuple(np.asarray(index).T)])
    assert (at_center[:300] < 0.05).all()
    assert (at_center[300:] >= 0.05).all()
    known = np.asarray(lookup.observed(grid.passes, grid.hits) | (grid.behind > 0))
    assert known[tuple(np.asarray(index).T)].all()
    expected = lookup.grid_sdf(CONFIG, grid.surface, samples.points_world)
    np.testing.assert_allclose(samples.sdf, expected, atol=1e-6)
    nothing = from_grid.sample_grid(CONFIG, empty_grid(), jax.random.key(0))
    assert not np.asarray(nothing.weight).any()


@given(
    mask=st.lists(st.booleans(), min_size=1, max_size=200),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=30, deadline=None)
def test_draws_are_of_the_true_elements(mask, seed):
    every = np.flatnonzero(mask)
    index, possible = draw_from_mask(jnp.asarray(mask), 50, jax.random.key(seed))
    assert bool(possible) == (len(every) > 0)
    if len(every):
        rank = jax.random.randint(jax.random.key(seed), (50,), 0, len(every))
        np.testing.assert_array_equal(index, every[np.asarray(rank)])


def test_draws_are_uniform_and_ignore_padding():
    mask = np.zeros(40, bool)
    mask[[3, 7, 8, 20, 39]] = True
    index, possible = draw_from_mask(jnp.asarray(mask), 20_000, jax.random.key(1))
    values, counts = np.unique(index, return_counts=True)
    assert values.tolist() == [3, 7, 8, 20, 39]
    assert np.sum((counts - 4000) ** 2 / 4000) < 18.5  # chi-square, 4 degrees, p = 0.001
    assert bool(possible)
    compact, _ = draw_from_mask(jnp.ones(5, bool), 20_000, jax.random.key(1))
    np.testing.assert_array_equal(np.flatnonzero(mask)[np.asarray(compact)], index)
    assert not bool(draw_from_mask(jnp.zeros(5, bool), 3, jax.random.key(1))[1])
