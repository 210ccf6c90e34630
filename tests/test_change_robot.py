"""Ghosts inside the robot are removed, and nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import arrays_equal
from voxels import CONFIG, SHAPE, empty_window, fuse, trace, uniform

from hiosdf_jax._src.change.robot import clear_robot

SENSOR = np.array([0.31, 0.52, 0.63])
clear = jax.jit(clear_robot, static_argnums=0)


@pytest.fixture(scope="module")
def window():
    """Patches in most voxels, passes in many, some of them hidden, and changes."""
    ends = uniform(1, 900)
    window = trace(fuse(empty_window(), ends, SENSOR), ends, SENSOR)
    rng = np.random.default_rng(2)
    sign = np.where(rng.random(SHAPE) < 0.3, -1, 1)
    change = rng.integers(-72, 9, SHAPE).astype(np.int8)
    return window._replace(passes=window.passes * sign, change=jnp.asarray(change))


def inside_of(window, centers, radii):
    """A mask of the patches whose centers lie in a sphere, by a loop in float64."""
    found = np.zeros(SHAPE, bool)
    for cell in np.argwhere(np.asarray(window.hits) > 0):
        mean = np.asarray(window.mean, np.float64)[tuple(cell)]
        patch = (cell + CONFIG.corner_index + 0.5 + mean) * CONFIG.voxel_size
        found[tuple(cell)] = any(
            np.linalg.norm(patch - center) < radius
            for center, radius in zip(centers, radii, strict=True)
        )
    return found


@pytest.mark.parametrize("seed", range(4))
def test_patches_in_spheres_are_removed_and_others_are_kept(window, seed):
    rng = np.random.default_rng(seed)
    centers = uniform(seed, 5, (-0.5, -0.2, 0.0), (1.1, 1.2, 1.2))  # some beyond the grid
    radii = rng.uniform(0.01, 0.5, 5).astype(np.float32)  # up to five voxels
    cleared = clear(CONFIG, window, jnp.asarray(centers), jnp.asarray(radii))
    ghosts = inside_of(window, centers.astype(float), radii.astype(float))
    assert 20 < ghosts.sum() < 0.9 * np.sum(np.asarray(window.hits) > 0)
    for name in ("hits", "weight", "behind"):
        expected = np.where(ghosts, 0, np.asarray(getattr(window, name)))
        np.testing.assert_array_equal(getattr(cleared, name), expected)
    passes = np.asarray(window.passes)
    expected = np.where(ghosts, np.maximum(np.abs(passes), 1), passes)
    np.testing.assert_array_equal(cleared.passes, expected)
    for name in ("start", "mean", "axes"):
        np.testing.assert_array_equal(getattr(cleared, name), getattr(window, name))
    np.testing.assert_array_equal(
        np.asarray(cleared.change)[~ghosts], np.asarray(window.change)[~ghosts]
    )


def test_a_sphere_of_many_voxels_keeps_no_patch(window):
    centers, radii = np.array([[0.3, 0.4, 0.5]], np.float32), np.array([0.75], np.float32)
    ghosts = inside_of(window, centers.astype(float), radii.astype(float))
    cleared = clear(CONFIG, window, jnp.asarray(centers), jnp.asarray(radii))
    assert ghosts.sum() > 200
    np.testing.assert_array_equal(np.asarray(cleared.hits)[ghosts], 0)


def test_spheres_without_a_patch_change_nothing(window):
    apart = np.array([[9.0, 0, 0], [0.3, 0.5, 0.6], [0.3, 0.5, 0.6]], np.float32)
    none = jnp.asarray([3.0, 0.0, 0.0], jnp.float32)
    assert arrays_equal(clear(CONFIG, window, jnp.asarray(apart), none), window)
    empty = empty_window()
    whole = jnp.asarray([0.3, 0.4, 0.5], jnp.float32)
    assert arrays_equal(clear(CONFIG, empty, jnp.asarray(apart), whole), empty)
