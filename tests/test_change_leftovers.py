"""New hits outweigh old ones beside a thing that has left, and nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from scipy.spatial.distance import cdist
from voxels import BOUNDS, CONFIG, SHAPE, empty_window, fuse, fuse_hits, rays_to, uniform

from hiosdf_jax._src.change import leftovers, vanishing

SENSOR = np.array([-0.25, 0.55, 0.65])

fade = jax.jit(leftovers.fade_leftovers, static_argnums=0)


def block(shape, first):
    """Indices of a block of voxels, (n, 3)."""
    return np.add(np.argwhere(np.ones(shape)), first)


def evidence(seed, vanished):
    """Random evidence; some voxels have vanished, or held something new or doubtful."""
    rng = np.random.default_rng(seed)
    change = np.where(rng.random(SHAPE) < 0.3, rng.integers(-64, 9, SHAPE), 0)
    change[tuple(vanished.T)] = rng.integers(-72, -64, len(vanished))
    counts = {
        name: jnp.asarray(rng.integers(low, 60, SHAPE), jnp.float32)
        for name, low in (("hits", 0), ("passes", -60), ("behind", 0), ("weight", 0))
    }
    axes = rng.uniform(0.1, 0.4, (*SHAPE, 3, 1)) * np.eye(3)
    return empty_window()._replace(
        change=jnp.asarray(change, jnp.int8), axes=jnp.asarray(axes, jnp.float16), **counts
    )


def expected_share(window, ends, vanished):
    """The share of its weight that each voxel keeps, by loops."""
    share = np.ones(SHAPE)
    cells = np.floor((ends - BOUNDS[0]) / CONFIG.voxel_size).astype(int)
    for cell in np.argwhere(np.ones(SHAPE)):
        new = int(np.sum(np.all(cells == cell, axis=1)))
        apart = cdist(vanished, cell[None], "chebyshev")
        long, middle, _ = np.linalg.norm(np.float64(window.axes[tuple(cell)]), axis=1)
        area = min(2 * 0.9 * 3**0.5 * long, 1) * min(2 * 0.9 * 3**0.5 * middle, 1)
        if new and area >= 0.5 and np.sum(apart <= 4) >= 16 and np.any(apart <= 2):
            share[tuple(cell)] = min(1, 0.1 * new / max(float(window.hits[tuple(cell)]), 1))
    return share


@pytest.mark.parametrize(("seed", "count"), [(0, 15), (1, 16), (2, 40)])
def test_old_hits_count_less_beside_things_that_have_left(seed, count):
    rng = np.random.default_rng(seed)
    vanished = rng.permutation(block((4, 4, 3), (5, 3, 2)))[:count]
    window = evidence(seed, vanished)
    # Some voxels meet many rays, others one or none.
    ends = np.concatenate([uniform(seed, 300), np.repeat(uniform(seed + 9, 6), 50, axis=0)])
    hit = rng.random(len(ends)) < 0.8
    faded = fade(CONFIG, window, rays_to(ends, SENSOR, hit=hit))
    share = expected_share(window, ends[hit], vanished)
    assert (share.min() < 0.1) == (count >= 16)
    np.testing.assert_allclose(faded.weight, share * np.asarray(window.weight), rtol=1e-6)
    assert arrays_equal(faded._replace(weight=window.weight), window)


def test_nothing_fades_in_a_world_that_stands_still():
    window = evidence(0, np.zeros((0, 3), int))
    rays = rays_to(uniform(1, 300), SENSOR)
    assert arrays_equal(fade(CONFIG, window, rays), window)
    # Nor by rows that do not end on a surface.
    left = evidence(0, block((4, 4, 3), (5, 3, 2)))
    assert arrays_equal(fade(CONFIG, left, rays._replace(ends=jnp.zeros(300, bool))), left)


def test_a_floor_forgets_the_feet_of_a_chair_in_two_scans():
    """Half of a voxel's old hits were 8 cm above the floor; each scan has two on the floor."""
    rng = np.random.default_rng(0)
    cell = (6, 5, 0)  # its lower face is at z = 0.2
    low = np.add(BOUNDS[0], 0.1 * np.array(cell))

    def hits(count, height):
        flat = rng.uniform(0.01, 0.09, (count, 2))
        return low + np.concatenate([flat, np.full((count, 1), height)], axis=1)

    def height(window):
        return 0.1 * (0.5 + float(window.mean[cell][2]))

    window = fuse(empty_window(), np.concatenate([hits(20, 0.01), hits(20, 0.09)]), SENSOR)
    assert height(window) == pytest.approx(0.05, abs=2e-3)
    gone = block((2, 2, 4), (6, 5, 1))
    change = np.zeros(SHAPE, np.int8)
    change[tuple(gone.T)] = -72
    seen = {}
    for name, window_k in (
        ("left", window._replace(change=jnp.asarray(change))),
        ("stays", window),
    ):
        for _ in range(2):
            rays = rays_to(hits(2, 0.01), SENSOR)
            window_k = fuse_hits(CONFIG, fade(CONFIG, window_k, rays), rays)
        seen[name] = height(window_k)
        assert float(window_k.hits[cell]) == 44
    assert seen["left"] == pytest.approx(0.01, abs=0.002)
    assert seen["stays"] > 0.04


@pytest.mark.parametrize("count", [15, 16])
def test_a_thing_has_left_where_many_voxels_have_vanished(count):
    rng = np.random.default_rng(count)
    cells = rng.permutation(block((3, 3, 3), (8, 1, 0)))[:count]
    change = np.full(SHAPE, -64, np.int8)
    change[tuple(cells.T)] = -65
    every = np.argwhere(np.ones(SHAPE))
    near = np.sum(cdist(every, cells, "chebyshev") <= 4, axis=1).reshape(SHAPE)
    found = vanishing.where_things_left(jnp.asarray(change))
    np.testing.assert_array_equal(found, near >= 16)
    assert found.any() == (count == 16)
