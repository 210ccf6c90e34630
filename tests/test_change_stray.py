"""Stray returns against a count over all returns of their cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from voxels import rays_to

from hiosdf_jax._src.change import directions, stray
from hiosdf_jax._src.numerics.vectors import split

find_stray = jax.jit(stray.find_stray)
pixel_of = jax.jit(lambda offset: directions.pixel_of(split(offset)))

SENSOR = np.array([0.5, -0.25, 0.125])


def camera(count, ranges, seed=0):
    """Rays in a cone of 10 degrees to each side."""
    rng = np.random.default_rng(seed)
    ahead = np.stack([np.ones(count), *rng.uniform(-0.18, 0.18, (2, count))], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return rays_to(SENSOR + ahead * np.reshape(ranges, (-1, 1)), SENSOR)


def stray_by_a_loop(rays):
    """The definition: fewer than 3, or 1.5 %, of those in 3 x 3 cells are within about 3 %."""
    line, column = np.divmod(np.asarray(pixel_of(rays.directions_world)), 256)
    row, column = line // 4, column // 4
    in_range = np.asarray(rays.in_range)
    part = np.floor(32 * np.log(np.asarray(rays.free_ranges, np.float64) / 0.02))
    result = np.zeros(len(row), bool)
    for k in np.flatnonzero(in_range):
        near = (np.abs(row - row[k]) <= 1) & (np.abs(column - column[k]) <= 1)
        here = in_range & near
        others = np.sum(here & (np.abs(part - part[k]) <= 1)) - 1
        result[k] = here.sum() >= 120 and others < max(3, 0.015 * here.sum())
    return result


@pytest.mark.parametrize("seed", range(2))
def test_stray_returns_against_a_loop(seed):
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random(6000) < 0.05, rng.uniform(0.1, 3, 6000), 2 + rng.random(6000) / 50)
    rays = camera(6000, ranges, 100 + seed)
    rays = rays._replace(in_range=jnp.asarray(rng.random(6000) < 0.9))
    found, expected = np.asarray(find_stray(rays)), stray_by_a_loop(rays)
    assert 50 < expected.sum() < 400
    # Rounding may put a range into the next bin.
    assert np.mean(found != expected) < 1e-3
    assert not found[~np.asarray(rays.in_range)].any()


@pytest.mark.parametrize("seed", range(3))
def test_a_small_cloud_is_counted_the_same_by_pairs_and_by_table(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random(1000) < 0.1, rng.uniform(0.01, 3, 1000), 2 + rng.random(1000) / 50)
    rays = camera(1000, ranges, seed)
    narrow = np.asarray(rays.directions_world) * (1, 0.5, 0.5)  # dense enough to have stray returns
    narrow /= np.linalg.norm(narrow, axis=1, keepdims=True)
    turned = narrow @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rays = rays._replace(
        directions_world=jnp.float32(turned), in_range=jnp.asarray(rng.random(1000) < 0.9)
    )
    by_pairs = np.asarray(jax.jit(stray.find_stray)(rays))
    monkeypatch.setattr(stray, "_MOST_BY_PAIRS", 0)
    by_table = np.asarray(jax.jit(lambda rays: stray.find_stray(rays))(rays))
    np.testing.assert_array_equal(by_pairs, by_table)
    assert by_pairs.sum() > 10
    assert np.mean(by_pairs != stray_by_a_loop(rays)) < 2e-3


def test_pairs_are_counted_up_to_the_largest_small_cloud():
    count = stray._MOST_BY_PAIRS
    place = tuple(jnp.zeros(count, jnp.int32) for _ in range(3))
    total, agreeing = jax.jit(stray._count_by_pairs)(jnp.ones(count, bool), place)
    np.testing.assert_array_equal(total, np.full(count, count))
    np.testing.assert_array_equal(agreeing, total)
    apart = (*place[:2], 3 * jnp.arange(count, dtype=jnp.int32))
    total, agreeing = jax.jit(stray._count_by_pairs)(jnp.ones(count, bool), apart)
    np.testing.assert_array_equal(total, np.full(count, count))
    np.testing.assert_array_equal(agreeing, np.ones(count))


def test_outliers_of_a_dense_cloud_are_stray_and_thin_things_are_not():
    ranges = np.full(6000, 2.0)
    ranges[:30] = np.linspace(0.4, 1.4, 30)  # each on its own
    rays = camera(6000, ranges)
    wire = np.abs(np.asarray(rays.directions_world)[:, 1]) < 0.004  # 0.5 degrees wide
    wire[:30] = False
    thin = camera(6000, np.where(wire, 1.0, ranges))
    assert 80 < wire.sum() < 200
    found = np.asarray(find_stray(thin))
    assert found[:30].mean() > 0.8
    assert not found[30:][~wire[30:]].any()
    assert found[wire].mean() < 0.1


def test_a_sparse_cloud_has_no_stray_returns():
    rng = np.random.default_rng(1)
    assert not np.asarray(find_stray(camera(300, rng.uniform(0.2, 3, 300)))).any()
