"""Clouds as images by direction, against the octahedral map and loops in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from voxels import rays_to

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.numerics.vectors import split

EDGE = 256
pixel_of = jax.jit(lambda offset: directions.pixel_of(split(offset)))
neighbor_pixels = jax.jit(lambda offset: directions.neighbor_pixels(split(offset)))
range_image = jax.jit(directions.range_image)
fill_gaps = jax.jit(directions.fill_gaps)
spread_nearest = jax.jit(directions.spread_nearest)


def unfolded(x, y):
    """The directions at places of the square [-1, 1]^2, float64."""
    z = 1 - np.abs(x) - np.abs(y)
    folded_x = np.copysign(1 - np.abs(y), x)
    folded_y = np.copysign(1 - np.abs(x), y)
    x, y = np.where(z < 0, folded_x, x), np.where(z < 0, folded_y, y)
    directions = np.stack([x, y, z], axis=-1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def random_directions(seed, count):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_the_middle_of_each_pixel_falls_in_that_pixel():
    line, column = np.divmod(np.arange(EDGE**2), EDGE)
    middle = unfolded(2 * (column + 0.5) / EDGE - 1, 2 * (line + 0.5) / EDGE - 1)
    lengths = np.random.default_rng(0).uniform(0.01, 100, (EDGE**2, 1))
    pixel = pixel_of((lengths * middle).astype(np.float32))
    np.testing.assert_array_equal(pixel, np.arange(EDGE**2))


def test_every_direction_falls_in_the_pixel_around_it():
    ahead = random_directions(1, 60_000)
    axes = np.concatenate([np.eye(3), -np.eye(3), [[0, 0, 0]], [[1, -1, 0], [0, 1, 1]]])
    pixel = np.asarray(pixel_of(np.concatenate([ahead, axes]).astype(np.float32)))
    assert ((pixel >= 0) & (pixel < EDGE**2)).all()
    line, column = np.divmod(pixel[:60_000], EDGE)
    middle = unfolded(2 * (column + 0.5) / EDGE - 1, 2 * (line + 0.5) / EDGE - 1)
    angle = np.degrees(np.arccos(np.clip(np.sum(ahead * middle, axis=1), -1, 1)))
    assert angle.max() < 1.0
    assert len(np.unique(pixel)) > 0.5 * EDGE**2


def test_neighbor_pixels_hold_nearby_directions():
    ahead = random_directions(2, 20_000)
    aside = np.cross(ahead, random_directions(3, 20_000))
    aside *= np.radians(0.3) / np.linalg.norm(aside, axis=1, keepdims=True)
    around = np.asarray(neighbor_pixels(ahead.astype(np.float32)))
    own = np.asarray(pixel_of(ahead.astype(np.float32)))
    near = np.asarray(pixel_of((ahead + aside).astype(np.float32)))
    assert around.shape == (20_000, 9)
    assert ((around >= 0) & (around < EDGE**2)).all()
    np.testing.assert_array_equal(around[:, 4], own)
    found = np.any(around == near[:, None], axis=1)
    line, column = np.divmod(own, EDGE)
    inner = (np.minimum(line, column) > 0) & (np.maximum(line, column) < EDGE - 1)
    assert inner.mean() > 0.9
    assert found[inner].all()
    assert (near != own).mean() > 0.25
    for k in np.flatnonzero(inner)[:50]:
        lines, columns = line[k] + np.arange(-1, 2), column[k] + np.arange(-1, 2)
        assert set(around[k]) == {a * EDGE + b for a in lines for b in columns}


@pytest.fixture(scope="module")
def cloud():
    """Rays all around, rows that are not in range, and which rows are chosen."""
    rng = np.random.default_rng(4)
    ahead = np.concatenate([random_directions(5, 3000), random_directions(6, 300).repeat(4, 0)])
    ahead[3000:] += 0.002 * rng.normal(size=(1200, 3))  # several in a pixel
    ahead[3100:3200] = ahead[3000:3100]  # two in the same direction
    reach = rng.uniform(0.2, 3, (4200, 1))
    reach[3100:3150] = reach[3000:3050]  # as far as each other
    sensor = np.array([0.5, -0.25, 0.125])
    rays = rays_to(sensor + reach * ahead, sensor)
    in_range = rng.random(4200) < 0.9
    return rays._replace(in_range=jnp.asarray(in_range)), rng.random(4200) < 0.6


def test_the_image_against_a_loop(cloud):
    rays, chosen = cloud
    image = range_image(rays, jnp.asarray(chosen))
    nearest, farthest = np.full(EDGE**2, np.inf), np.full(EDGE**2, -1.0)
    row = np.full(EDGE**2, -1)
    pixel, ranges = np.asarray(pixel_of(rays.directions_world)), np.asarray(rays.free_ranges)
    several = 0
    for k in np.flatnonzero(chosen & np.asarray(rays.in_range)):
        at, reach = pixel[k], ranges[k]
        several += row[at] >= 0
        nearest[at] = min(nearest[at], reach)
        if reach >= farthest[at]:  # the last of equal ones
            farthest[at], row[at] = reach, k
    assert several > 300
    for result, expected in zip(image, (nearest, farthest, row), strict=True):
        np.testing.assert_array_equal(result, expected)


def square_around(values, at, reach):
    """The values up to `reach` pixels away from a pixel; there are none off the edges."""
    line, column = divmod(at, EDGE)
    values = values.reshape(EDGE, EDGE)
    return values[
        max(line - reach, 0) : line + reach + 1, max(column - reach, 0) : column + reach + 1
    ]


def filled_twice(values, empty, best):
    """Fills empty pixels with the best around them: first 3 x 3 pixels, then 5 x 5."""
    for reach in (1, 2):
        result = values.copy()
        for at in np.flatnonzero(empty(values)):
            result[at] = best(square_around(values, at, reach))
        values = result
    return values


@pytest.fixture(scope="module")
def images(cloud):
    rays, chosen = cloud
    return range_image(rays, jnp.asarray(chosen)), range_image(rays, rays.in_range)


def test_gaps_are_filled_with_what_is_around_them(images):
    _, measured = images
    filled = fill_gaps(measured)
    farthest = np.asarray(measured.farthest)
    expected = filled_twice(farthest, lambda values: values < 0, np.max)
    np.testing.assert_array_equal(filled.farthest, expected)
    nearest = filled_twice(np.asarray(measured.nearest), np.isinf, np.min)
    np.testing.assert_array_equal(filled.nearest, nearest)
    np.testing.assert_array_equal(filled.row, measured.row)
    assert np.mean(farthest < 0) > 0.9 > 0.6 > np.mean(expected < 0) > 0.01


def test_nearest_ranges_spread_only_to_pixels_that_no_ray_has_measured(images):
    some, measured = images
    unmeasured = np.asarray(measured.farthest) < 0
    values = np.asarray(some.nearest)
    result = np.asarray(spread_nearest(some, measured))
    expected = filled_twice(values, lambda values: unmeasured & np.isinf(values), np.min)
    np.testing.assert_array_equal(result, expected)
    np.testing.assert_array_equal(result[~unmeasured], values[~unmeasured])
    assert np.isinf(values[~unmeasured]).sum() > 300
    assert np.isfinite(result).sum() > 5 * np.isfinite(values).sum()


@pytest.mark.parametrize(
    ("ranges", "least", "most"),
    [("equal", 0.99, 1.0), ("edge", 0.9, 0.99), ("random", 0.0, 0.05), ("sparse", -1.0, -1.0)],
)
def test_neighboring_rays_are_alike_in_a_view_and_not_in_noise(ranges, least, most):
    ahead = random_directions(7, 40_000)
    ahead = ahead[ahead[:, 2] > 0]
    rng, count = np.random.default_rng(8), len(ahead)
    length = {
        "equal": 2 + 0.01 * rng.normal(size=count),
        "edge": np.where(ahead[:, 0] > 0.1, 1.0, 3.0) + 0.01 * rng.normal(size=count),
        "random": rng.uniform(0.5, 5, count),
        "sparse": rng.uniform(0.5, 5, count),
    }[ranges]
    rays = rays_to(length[:, None] * ahead, (0, 0, 0))
    chosen = jnp.arange(count) < (300 if ranges == "sparse" else count)
    rays = rays._replace(in_range=chosen)
    share = float(jax.jit(directions.smoothness)(rays, chosen))
    assert least <= share <= most
