"""The window of evidence around a sensor, and how evidence fades."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from voxels import (
    CONFIG,
    SHAPE,
    empty_window,
    fade_evidence,
    fuse,
    fuse_hits,
    rays_to,
    trace,
    trace_rays,
    whole_window,
)

from hiosdf_jax._src.grid import evidence, geometry


@pytest.mark.parametrize("sensor", [(0.31, 0.52, 0.63), (0.95, 0.95, 0.15), (1.0, 0.5, 0.6)])
def test_a_cloud_changes_only_the_window_around_the_sensor(sensor):
    config = dataclasses.replace(CONFIG, max_range=0.15, voxel_size=0.05, min_range=0.0)
    rng = np.random.default_rng(11)
    away = rng.normal(size=(300, 3))
    reach = rng.uniform(0.05, 0.15, (300, 1))
    ends = (np.array(sensor) + reach * away / np.linalg.norm(away, axis=1)[:, None]).astype(
        np.float32
    )
    rays = rays_to(ends, sensor)
    whole, parts, sizes = empty_window(config), evidence.empty_grid(config).evidence, set()
    for _ in range(3):
        whole = trace(fuse(whole, ends, sensor, config=config), ends, sensor, config=config)
        whole = fade_evidence(config, whole)
        window = evidence.read_window(config, parts, rays)
        sizes.add(window.hits.shape)
        window = trace_rays(config, fuse_hits(config, window, rays), rays)
        parts = evidence.write_window(parts, fade_evidence(config, window))
    assert all(part < all_of for part, all_of in zip(*sizes, whole.hits.shape, strict=True))
    assert np.sum(np.asarray(whole.hits)) > 30
    for name in ("hits", "passes", "behind"):
        stored = np.asarray(getattr(whole, name), np.float16)
        np.testing.assert_array_equal(getattr(parts, name), stored)
    np.testing.assert_allclose(
        np.asarray(parts.root_weight, np.float32) ** 2, whole.weight, rtol=4e-3, atol=1e-6
    )
    np.testing.assert_allclose(parts.mean, whole.mean, atol=3e-3)


def test_evidence_fades_only_where_rays_pass():
    rng = np.random.default_rng(3)
    share = rng.random(SHAPE)
    counts = CONFIG.evidence_limit * rng.uniform(0.998, 1.002, SHAPE)
    window = empty_window()._replace(
        hits=jnp.asarray(share * counts, jnp.float32),
        passes=jnp.asarray((1 - share) * counts, jnp.float32),
    )
    stored = [evidence.empty_grid(CONFIG).evidence]
    for _ in range(3):
        stored.append(evidence.write_window(stored[0], fade_evidence(CONFIG, window)))
        window = whole_window(stored[-1])
    assert not arrays_equal(stored[1].hits, stored[0].hits)
    assert arrays_equal(stored[2], stored[1]) and arrays_equal(stored[3], stored[1])


def test_fading_against_its_definition():
    rng = np.random.default_rng(4)
    limit = CONFIG.evidence_limit
    hits, passes, behind = (limit * rng.uniform(0, 1.5, SHAPE) for _ in range(3))
    weight = rng.uniform(0.1, 5, SHAPE)
    window = empty_window()._replace(
        hits=jnp.asarray(hits, jnp.float32),
        passes=jnp.asarray(passes, jnp.float32),
        behind=jnp.asarray(behind, jnp.float32),
        weight=jnp.asarray(weight, jnp.float32),
    )
    faded = fade_evidence(CONFIG, window)
    scale = np.minimum(limit / (hits + passes), 1)
    assert 0.1 < (scale < 1).mean() < 0.9
    for name, exact in (("hits", hits), ("passes", passes), ("weight", weight)):
        # Up to 0.07 % above the limit nothing is scaled.
        np.testing.assert_allclose(getattr(faded, name), scale * exact, rtol=8e-4)
    np.testing.assert_allclose(faded.behind, np.minimum(behind, limit), rtol=1e-6)


def test_far_returns_are_averaged_like_near_ones():
    """Their weights are tiny: with this noise 1e-8 at 30 m."""
    config = dataclasses.replace(
        CONFIG, bounds=((28, -1, -1), (31, 1, 1)), max_range=40.0, range_noise=(0.001, 0.01)
    )
    stored = evidence.empty_grid(config).evidence
    offsets = np.random.default_rng(0).uniform(-0.04, 0.04, 40)
    for offset in offsets:
        rays = rays_to([[30.05 + offset, 0.05, 0.05]], np.zeros(3))
        window = fuse_hits(config, evidence.read_window(config, stored, rays), rays)
        stored = evidence.write_window(stored, window)
    index, _, _ = geometry.voxel_of(config, jnp.asarray([[30.05, 0.05, 0.05]]))
    mean = np.asarray(stored.mean)[tuple(np.asarray(index)[0])]
    assert abs(0.1 * mean[0] - offsets.mean()) < 1e-3


def test_a_voxel_is_reached_unless_it_is_hidden_or_no_ray_has_met_it():
    passes = jnp.asarray([0, 2, -2, 0, 3, -3], jnp.float32)
    hits = jnp.asarray([0, 0, 0, 1, 1, 9], jnp.float32)
    expected = [False, True, False, True, True, False]
    np.testing.assert_array_equal(evidence.is_reached(passes, hits), expected)


@pytest.mark.parametrize(
    ("passes", "hits", "behind", "expected"),
    [
        (0, 0, 0, False),  # no ray
        (0, 0, 5, False),  # behind a surface
        (1, 0, 0, True),  # free
        (1, 0, 10, True),
        (1, 0, 11, False),  # noise behind a surface
        (-5, 20, 0, False),  # hidden by a new surface
        (0, 1, 0, False),  # one return is no surface
        (0, 2, 0, True),
        (0, 2, 2, True),
        (0, 2, 3, False),  # noise behind a surface
        (0, 4, 6, True),
        (0, 4, 7, False),
        (2, 2, 100, False),
    ],
)
def test_a_voxel_is_observed_if_it_is_free_or_holds_a_surface(passes, hits, behind, expected):
    counts = (jnp.float32(count) for count in (passes, hits, behind))
    config = dataclasses.replace(CONFIG, min_hits=2)
    assert bool(evidence.is_observed(config, *counts)) == expected


def test_one_hit_is_an_observed_surface_where_one_is_asked_for():
    config = dataclasses.replace(CONFIG, min_hits=1)
    assert bool(evidence.is_observed(config, *map(jnp.float32, (0, 1, 0))))


def test_hidden_voxels_and_changes_are_stored():
    rng = np.random.default_rng(5)
    passes, change = rng.integers(-9, 10, SHAPE), rng.integers(-72, 9, SHAPE)
    window = empty_window()._replace(
        passes=jnp.asarray(passes, jnp.float32), change=jnp.asarray(change, jnp.int8)
    )
    stored = evidence.write_window(
        evidence.empty_grid(CONFIG).evidence, fade_evidence(CONFIG, window)
    )
    np.testing.assert_array_equal(stored.passes, passes)
    np.testing.assert_array_equal(stored.change, change)
    read = evidence.read_window(CONFIG, stored, rays_to([[0.3, 0.5, 0.7]], (0.3, 0.5, 0.6)))
    np.testing.assert_array_equal(read.passes, passes)
    np.testing.assert_array_equal(read.change, change)
    assert stored.change.dtype == jnp.int8
