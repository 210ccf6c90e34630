"""Each voxel's nearest patch by its rectangle, against loops over voxels in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.grid.nearest import Part, nearest_sites
from hiosdf_jax._src.grid.rectangles import nearest_rectangles, with_margin


def random_patches(seed, shape, share):
    """Sites, their means and axes: rectangles of all shapes that stay near their voxels."""
    rng = np.random.default_rng(seed)
    sites = rng.random(shape) < share
    mean = rng.uniform(-0.5, 0.5, (*shape, 3)).astype(np.float16)
    rotation = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))[0]
    deviation = np.sort(rng.uniform(0.001, 0.35, (*shape, 3)))[..., ::-1]
    return sites, mean, (rotation * deviation[..., None]).astype(np.float16)


def refined(nearest, horizon, part, mean, axes):
    search = jax.jit(functools.partial(nearest_rectangles, horizon=horizon, part=part))
    return np.asarray(search(nearest, mean=jnp.asarray(mean), axes=jnp.asarray(axes)))


def squared_distance(voxel, row, horizon, mean, axes):
    """From a voxel's center to the rectangle of half the size, voxels^2."""
    site = np.unravel_index(row, mean.shape[:3])
    offset = np.array(voxel) - site - mean[site].astype(np.float64)
    if offset @ offset > horizon**2:
        return np.inf
    for axis in axes[site].astype(np.float64)[:2]:
        half = 0.78 * axis
        offset -= np.clip(offset @ half / (half @ half), -1, 1) * half
    return offset @ offset


def slow_rectangles(nearest, horizon, start, mean, axes):
    """One pass per axis, voxel by voxel."""
    for axis in range(3):
        before, nearest = nearest, nearest.copy()
        for cell in np.argwhere(before >= 0):
            voxel = cell + start
            best = squared_distance(voxel, before[tuple(cell)], horizon, mean, axes)
            for step in (-1, 1):
                beside = cell + step * np.eye(3, dtype=int)[axis]
                if not 0 <= beside[axis] < before.shape[axis] or before[tuple(beside)] < 0:
                    continue
                square = squared_distance(voxel, before[tuple(beside)], horizon, mean, axes)
                if square < best - 1e-3:
                    best, nearest[tuple(cell)] = square, before[tuple(beside)]
    return nearest


def test_rectangles_against_loops_over_voxels():
    shape, part = (15, 12, 11), Part((1, 0, 2), (12, 12, 8))
    for seed, share in enumerate((0.0, 0.002, 0.03, 0.5)):
        sites, mean, axes = random_patches(seed, shape, share)
        nearest, _ = nearest_sites(jnp.asarray(sites)[None], jnp.asarray(mean), 6, part)
        expected = slow_rectangles(np.asarray(nearest[0]), 6, part.start, mean, axes)
        found = refined(nearest[0], 6, part, mean, axes)
        # Next to the least gain, rounding may choose.
        assert np.mean(found != expected) < 2e-3
        assert np.array_equal(found < 0, np.asarray(nearest[0]) < 0)
        if share == 0.03:
            assert np.mean(found != np.asarray(nearest[0])) > 0.02


def test_a_part_with_its_margin_gives_the_result_of_the_whole():
    shape = (14, 13, 12)
    sites, mean, axes = random_patches(7, shape, 0.02)

    def search(part):
        nearest, _ = nearest_sites(jnp.asarray(sites)[None], jnp.asarray(mean), 40, part)
        return refined(nearest[0], 40, part, mean, axes)

    whole = search(Part((0, 0, 0), shape))
    for part in (
        Part((3, 2, 4), (6, 5, 4)),
        Part((0, 8, 0), (14, 5, 3)),
        Part((1, 1, 1), (13,) * 3),
    ):
        part = Part(part.start, tuple(min(n, s) for n, s in zip(part.shape, shape, strict=True)))
        larger = with_margin(shape, part)
        start = [int(a) - int(b) for a, b in zip(part.start, larger.start, strict=True)]
        inner = tuple(slice(a, a + n) for a, n in zip(start, part.shape, strict=True))
        outer = tuple(slice(a, a + n) for a, n in zip(part.start, part.shape, strict=True))
        np.testing.assert_array_equal(search(larger)[inner], whole[outer])
