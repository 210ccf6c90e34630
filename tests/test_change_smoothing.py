"""Smoothed ranges against a least-squares fit around each ray, and what must stay as it is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from room import arrays_equal
from voxels import CONFIG, rays_to

from hiosdf_jax._src.change import directions, smoothing
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.vectors import split

SENSOR = np.array([0.0, 0.5, 0.5])
NOISE = 0.05  # m
WIDE = dataclasses.replace(CONFIG, bounds=((-1, -3, -3), (6, 4, 4)), max_range=8.0)

smooth = jax.jit(smoothing.smooth_ranges, static_argnums=0)
pixel_of = jax.jit(lambda offset: directions.pixel_of(split(offset)))


def camera(count, range_of, noise=NOISE, seed=0):
    """Noisy rays in a cone of 9 degrees to each side, and their true ranges."""
    rng = np.random.default_rng(seed)
    ahead = np.stack([np.ones(count), *rng.uniform(-0.16, 0.16, (2, count))], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    ranges = range_of(ahead)
    measured = ranges + noise * rng.normal(size=count)
    rays = rays_to(SENSOR + ahead * measured[:, None], SENSOR)
    return rays._replace(sigma=jnp.full(count, noise, jnp.float32)), ranges


def tilted_wall(ahead):
    normal = np.array([0.8, 0.6, 0.0])
    return 2.0 / (ahead @ normal)


def ranges_of(rays):
    return np.linalg.norm(np.asarray(rays.points_world, np.float64) - SENSOR, axis=1)


def smooth_by_a_loop(rays):
    """The definition, in float64: fits of the inverse range to the rays in pixels nearby, twice."""
    line, column = np.divmod(np.asarray(pixel_of(rays.directions_world)), directions.EDGE)
    ahead, ranges = np.asarray(rays.directions_world, np.float64), ranges_of(rays)
    sigma = np.asarray(rays.sigma, np.float64)
    place = line * directions.EDGE + column
    counts = np.bincount(place, minlength=directions.EDGE**2)
    mean = np.bincount(place, ranges, directions.EDGE**2) / np.maximum(counts, 1)
    near = (np.abs(line[:, None] - line) <= 3) & (np.abs(column[:, None] - column) <= 3)
    near &= np.abs(mean[place][:, None] - mean[place]) <= 3 * sigma[:, None]
    fits = np.empty(len(ranges))
    for k, chosen in enumerate(near):
        offsets, values = ahead[chosen] - ahead[chosen].mean(axis=0), 1 / ranges[chosen]
        spread = offsets.T @ offsets / chosen.sum() + 1e-5 * np.eye(3)
        slope = np.linalg.solve(spread, offsets.T @ (values - values.mean()) / chosen.sum())
        fits[k] = 1 / (values.mean() + (ahead[k] - ahead[chosen].mean(axis=0)) @ slope)
    moved = np.abs(fits - ranges) <= 3 * sigma
    result = np.array(ranges)
    for k in np.flatnonzero(moved):
        chosen = near[k] & moved
        result[k] = fits[k] + np.mean((ranges - fits)[chosen])
    return result


def test_ranges_are_those_of_the_fits_around_each_ray():
    rays, _ = camera(1500, tilted_wall)
    found, expected = ranges_of(smooth(WIDE, rays)), smooth_by_a_loop(rays)
    assert np.quantile(np.abs(found - expected), 0.99) < 2e-3
    assert np.abs(found - ranges_of(rays)).max() > 0.05


def test_noise_on_a_wall_shrinks_and_leaves_no_bias():
    rays, truth = camera(6000, tilted_wall)
    before, after = ranges_of(rays) - truth, ranges_of(smooth(WIDE, rays)) - truth
    assert np.abs(before).mean() > 0.035
    assert np.abs(after).mean() < 0.35 * np.abs(before).mean()
    assert abs(after.mean()) < 0.004


def test_a_convex_edge_is_not_moved_away():
    """A distance that is too large would be optimistic."""

    def edge(ahead):
        sides = np.array([[0.7, 0.7, 0.0], [0.7, -0.7, 0.0]])
        return np.max(1.4 / (ahead @ sides.T), axis=1)

    rays, truth = camera(6000, edge)
    near = np.abs(np.asarray(rays.directions_world)[:, 1]) < 0.02
    error = (ranges_of(smooth(WIDE, rays)) - truth)[near]
    assert error.mean() < 0.004
    assert np.quantile(error, 0.9) < 0.015


def test_a_step_between_two_walls_stays():
    def step(ahead):
        return np.where(ahead[:, 1] > 0, 2.0, 2.6)

    rays, truth = camera(6000, step)
    after = ranges_of(smooth(WIDE, rays))
    assert np.mean(np.abs(after - truth) < 0.15) > 0.99
    edge = np.abs(np.asarray(rays.directions_world)[:, 1]) < 0.02
    assert np.mean(np.abs(after - truth)[edge] > 0.2) < 0.05


def test_rays_with_little_noise_or_without_a_return_stay_bit_by_bit():
    rays, _ = camera(500, tilted_wall)
    precise = rays._replace(sigma=jnp.full(500, 0.01, jnp.float32))
    assert arrays_equal(smooth(WIDE, precise), precise)
    missing = rays._replace(ends=jnp.zeros(500, bool))
    assert arrays_equal(smooth(WIDE, missing), missing)


def test_rows_without_a_return_change_no_other_row():
    rays, _ = camera(800, tilted_wall)
    ends = jnp.arange(800) < 600
    part = Rays(*(x[:600] if x.shape[:1] == (800,) else x for x in rays))
    padded = smooth(WIDE, rays._replace(ends=ends))
    np.testing.assert_allclose(
        np.asarray(padded.points_world)[:600], smooth(WIDE, part).points_world, atol=1e-4
    )


def test_neighbors_beyond_the_edge_of_the_image_are_left_out():
    """Opposite edges of the image are far apart in the world."""
    rng = np.random.default_rng(0)
    low = np.stack([rng.normal(0, 0.02, 400) - 0.7, rng.normal(0, 0.02, 400), -np.ones(400)], 1)
    ahead = np.concatenate([low, low * [-1, 1, 1]])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    ranges = np.where(np.arange(800) < 400, 1.0, 1.1)
    rays = rays_to(SENSOR + ahead * ranges[:, None], SENSOR)
    rays = rays._replace(sigma=jnp.full(800, NOISE, jnp.float32))
    np.testing.assert_allclose(ranges_of(smooth(WIDE, rays)), ranges, atol=2e-3)
