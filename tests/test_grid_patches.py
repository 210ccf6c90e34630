"""Surface patches against moments, eigenvectors and distances in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room import arrays_equal
from voxels import CONFIG, SHAPE, empty_window, fade_evidence, fuse, trace, uniform

from hiosdf_jax._src.grid import patches
from hiosdf_jax._src.numerics.vectors import split


def test_patches_are_the_weighted_moments_of_all_hits():
    sensor = np.array([0.3, 0.5, 0.6])
    clouds = [uniform(k, 900, (0.0, 0.1, 0.3), (0.3, 0.4, 0.5)) for k in range(3)]
    window = empty_window()
    for cloud in clouds:
        window = fuse(window, cloud, sensor)
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
        assert float(window.hits[at]) == here.sum()
        np.testing.assert_allclose(window.weight[at], w.sum(), rtol=1e-4)
        np.testing.assert_allclose(window.mean[at], mean, atol=2e-3)  # float16
        axes = np.asarray(window.axes[at], np.float64)
        np.testing.assert_allclose(axes.T @ axes, spread, atol=1e-3)
        lengths = np.linalg.norm(axes, axis=1)
        assert lengths[0] >= lengths[1] >= lengths[2]
        normal = axes[2]
        assert normal @ ((sensor - center) / 0.1 - mean) >= -1e-3
    assert checked >= 12


@pytest.mark.parametrize("hits", [1, 2])
def test_the_normal_of_too_few_hits_points_to_the_sensor(hits):
    """It decides the side of voxels that no ray has met, so rounding must not decide it."""
    rng = np.random.default_rng(12)
    sensor = np.array([2.0, -1.5, 1.7])
    cells = np.argwhere(rng.random(SHAPE) < 0.3)
    centers = (cells + CONFIG.corner_index + 0.5) * 0.1
    points = centers[:, None] + rng.uniform(-0.04, 0.04, (len(cells), hits, 3))
    rows = np.zeros((900, 3), np.float32)
    rows[: points.size // 3] = points.reshape(-1, 3)
    window = fuse(empty_window(), rows, sensor, hit=np.arange(900) < points.size // 3)
    axes = np.asarray(window.axes, np.float64)[tuple(cells.T)]
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
    points = uniform(4, 300)
    padded = np.concatenate([points, uniform(5, 400), np.full((200, 3), 7.0, np.float32)])
    hit = np.arange(900) < 300
    hit[700:] = True  # these are outside
    assert arrays_equal(fuse(empty_window(), points), fuse(empty_window(), padded, hit=hit))


def test_the_order_of_rows_does_not_matter():
    points = uniform(6, 900, (0.0, 0.1, 0.3), (0.3, 0.4, 0.5))
    a, b = fuse(empty_window(), points), fuse(empty_window(), points[::-1].copy())
    np.testing.assert_array_equal(a.hits, b.hits)
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-3)
    spread = [
        jnp.einsum("...ki,...kj->...ij", window.axes, window.axes).astype(np.float32)
        for window in (a, b)
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


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([(0.3, 0.2), (0.3, 0.0), (0.0, 0.0)]))
def test_the_nearest_point_on_a_patch_against_a_dense_rectangle(seed, half):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    axes = rotation * np.array([*half, 0.01])[:, None]
    mean, point = rng.uniform(-0.5, 0.5, 3), rng.uniform(-4, 4, 3)
    # Smaller by up to 14 % between 2 and 5 voxels from its center.
    square = np.sum((point - mean) ** 2)
    scale = 0.9 * 3**0.5 * (1 - 0.14 * np.clip((square - 2**2) / (5**2 - 2**2), 0, 1))
    u = np.linspace(-1, 1, 401)
    rectangle = mean + scale * (u[:, None, None] * axes[0] + u[None, :, None] * axes[1]).reshape(
        -1, 3
    )
    nearest = rectangle[np.linalg.norm(rectangle - point, axis=1).argmin()]
    center = np.round(rng.uniform(-1, 1, 3))
    expected = np.linalg.norm(np.clip(nearest, -0.6, 0.6) - point)
    point32, mean32, center32, first, second = (
        split(jnp.asarray(x, jnp.float32))
        for x in (point + center, mean + center, center, axes[0], axes[1])
    )
    on_patch = patches.nearest_on_patch(point32, mean32, (first, second), center32)
    # The rectangle is sampled every 3 mm of a voxel of 1 m, and its nearest point moves along it.
    np.testing.assert_allclose(np.linalg.norm(on_patch.offset), expected, atol=3e-3)


def test_the_slope_of_the_distance_to_a_patch_against_finite_differences():
    rng = np.random.default_rng(0)
    count = 4000
    rotation = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    axes = rotation * rng.uniform(0, 0.35, (count, 3, 1))
    mean, point = rng.uniform(-0.5, 0.5, (count, 3)), rng.uniform(-4, 4, (count, 3))
    with jax.enable_x64(True):
        held = (split(jnp.asarray(x)) for x in (mean, axes[:, 0], axes[:, 1], 0 * mean))
        mean64, first, second, center = held

        def find(point):
            return patches.nearest_on_patch(
                split(jnp.asarray(point)), mean64, (first, second), center
            )

        slope = np.stack(find(point).slope, axis=-1)
        steps = 1e-6 * np.eye(3)
        ahead, back = (
            np.stack([np.linalg.norm(find(point + s * step).offset, axis=0) for step in steps], -1)
            for s in (1, -1)
        )
    wrong = np.abs((ahead - back) / 2e-6 - slope).max(axis=-1) > 1e-4
    assert wrong.mean() < 1e-3  # next to a kink
    outside = np.abs(mean[:, None] + 0.9 * 3**0.5 * axes[:, :2]).max(axis=(1, 2)) > 0.6
    assert outside.mean() > 0.3  # some rectangles reach out of their voxels


def test_a_vanished_wall_is_carved_and_a_new_one_counts_as_surface():
    sensor = np.array([0.05, 0.55, 0.65])
    near = uniform(8, 300, (0.42, 0.41, 0.51), (0.44, 0.69, 0.79))  # a wall that is removed later
    far = sensor + (near - sensor) * ((0.84 - sensor[0]) / (near[:, :1] - sensor[0]))
    window, history = empty_window(), []
    for cloud in [near] * 30 + [far] * 60:
        window = trace(fuse(window, cloud, sensor), cloud, sensor)
        window = fade_evidence(CONFIG, window)
        features = patches.is_feature(
            CONFIG, window.hits, window.passes, window.weight, window.axes
        )
        history.append((bool(features[7, 5, 4]), bool(features[11, 5, 4])))
    assert float(jnp.max(window.hits + window.passes)) <= CONFIG.evidence_limit * 1.001
    assert history[29] == (True, False)
    assert history[31][1]
    gone = next(k for k, (wall, _) in enumerate(history) if not wall and k >= 30)
    # The wall's evidence, at the limit, fades at the rate at which rays pass: within 60 clouds.
    assert 30 <= gone < 60
    assert history[-1] == (False, True)


def test_hidden_patches_are_still_surfaces_as_they_were():
    rng = np.random.default_rng(13)
    hits, passes = (rng.integers(0, 60, 500).astype(np.float32) for _ in range(2))
    axes = np.zeros((500, 3, 3), np.float32)
    axes[:, 0, 0] = axes[:, 1, 1] = rng.uniform(0.01, 0.3, 500)
    seen, hidden = (patches.is_feature(CONFIG, hits, s * passes, 0 * hits, axes) for s in (1, -1))
    np.testing.assert_array_equal(hidden, seen)
    assert 0.1 < np.mean(seen) < 0.95


@pytest.mark.parametrize(
    ("half", "sigma_voxels", "share"),
    [(0.29, 0.1, 1.0), (0.29, 0.3, 1.0), (0.15, 0.1, 0.6), (0.15, 0.3, 1.0)],
)
def test_small_patches_of_sharp_returns_need_fewer_hits(half, sigma_voxels, share):
    """By a loop over passes: a patch is carved below its share of the rays."""
    axes = jnp.diag(jnp.array([0.29, half, 0.01]))
    noise_floor, _ = CONFIG.range_noise
    weight = 20 * (noise_floor / (sigma_voxels * CONFIG.voxel_size)) ** 2
    area = min(2 * 0.9 * 3**0.5 * 0.29, 1) * min(2 * 0.9 * 3**0.5 * half, 1)
    least = share * CONFIG.min_hit_ratio * area
    for passes in range(0, 400, 7):
        kept = patches.is_feature(CONFIG, jnp.float32(20), jnp.float32(passes), weight, axes)
        assert bool(kept) == (20 / (20 + passes) >= least)
    # Three hits may be what is left of something that has moved on: all need the whole share.
    for ratio, expected in ((0.8, False), (1.2, True)):
        passes = jnp.float32(3 / (ratio * CONFIG.min_hit_ratio * area) - 3)
        kept = patches.is_feature(CONFIG, jnp.float32(3), passes, 0.15 * weight, axes)
        assert bool(kept) == expected


@pytest.mark.parametrize(("hits", "kept"), [(4.4, False), (4.6, True)])
def test_however_small_a_patch_needs_nine_of_two_hundred_rays(hits, kept):
    axes = jnp.diag(jnp.array([0.19, 0.04, 0.03]))  # a handle in the demo
    answer = patches.is_feature(CONFIG, jnp.float32(hits), jnp.float32(100 - hits), 1e-3, axes)
    assert bool(answer) == kept


def test_few_hits_behind_many_ends_are_noise():
    hits, behind = np.meshgrid(np.arange(20.0), np.arange(0.0, 101, 5))
    for passes, share in ((0.0, 0.1), (-3.0, 0.1), (2.0, 0.03)):
        noise = patches.is_behind_surface(hits, passes + 0 * hits, behind)
        np.testing.assert_array_equal(noise, np.float32(hits) < np.float32(share * behind))


def test_a_single_hit_is_in_doubt_sooner():
    """It may be stray: five rays beside it say so, where two hits need many."""
    passes = np.arange(200, dtype=np.float32)
    single = np.asarray(patches.is_doubtful(np.ones(200, np.float32), passes))
    np.testing.assert_array_equal(single, passes <= 5)  # 1 / 6 > 0.15 > 1 / 7
    double = np.asarray(patches.is_doubtful(np.full(200, 2, np.float32), passes))
    np.testing.assert_array_equal(double, passes <= 98)  # 2 / 100
    assert np.asarray(patches.is_doubtful(np.ones(200, np.float32), -passes)).all()
    assert not np.asarray(patches.is_doubtful(np.zeros(200, np.float32), passes)).any()
