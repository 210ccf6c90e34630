"""Rays pierce a wall that they cross from its front, and not one that they come from behind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.change.piercing import find_piercing
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.evidence import empty_grid
from hiosdf_jax._src.grid.geometry import voxel_center
from hiosdf_jax._src.grid.rays import place_cloud

CONFIG = Config.light(((-2.0, -2.0, -1.0), (2.0, 2.0, 1.0)), voxel_size=0.1, distance_horizon=0.8)
find = jax.jit(find_piercing, static_argnums=0)


def wall(new=False):
    """A wall at x = 0 that was seen from x > 0; the space far behind it is unknown."""
    grid = empty_grid(CONFIG)
    index = np.stack(np.meshgrid(*map(np.arange, CONFIG.grid_shape), indexing="ij"), axis=-1)
    x = np.asarray(voxel_center(CONFIG, index))[..., 0]
    horizon = CONFIG.distance_horizon
    sdf = np.where(x < -horizon, horizon, np.clip(x, -horizon, horizon))
    change = jnp.full(x.shape, 5 if new else 0, jnp.int8)
    return grid.replace(
        evidence=grid.evidence.replace(change=change),
        derived=grid.derived.replace(sdf=jnp.asarray(sdf, jnp.float16)),
    )


def pierced(grid, sensor, ends):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = sensor
    cloud = np.asarray(ends - sensor, np.float32)
    rays = place_cloud(CONFIG, cloud, np.ones(len(ends), bool), pose)
    return np.asarray(find(CONFIG, grid, rays))


def draw(low, high, count=300):
    return np.random.default_rng(0).uniform(low, high, (count, 3))


@pytest.mark.parametrize("x", [0.12, 0.5, 1.3])
def test_rays_from_the_front_pierce_the_wall_if_they_end_far_behind(x):
    sensor = np.array([x, 0.1, 0.0])
    assert pierced(wall(), sensor, draw([-1.9, -1, -0.9], [-0.4, 1, 0.9])).all()
    assert not pierced(wall(), sensor, draw([-0.05, -1, -0.9], [1.9, 1, 0.9])).any()


@pytest.mark.parametrize("x", [-0.05, -0.4, -1.0, -1.5])
def test_rays_from_behind_pierce_nothing(x):
    """A sensor in the next room stands where the wall's distance is negative, or unknown."""
    sensor = np.array([x, 0.1, 0.0])
    assert not pierced(wall(), sensor, draw([-1.9, -1.9, -0.9], [1.9, 1.9, 0.9])).any()


def test_new_walls_do_not_count():
    """They may have moved on."""
    ends = draw([-1.9, -1, -0.9], [-0.4, 1, 0.9])
    assert not pierced(wall(new=True), np.array([0.5, 0.1, 0.0]), ends).any()
