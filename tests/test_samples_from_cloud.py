"""Training samples from the newest cloud against a k-d tree and the paper's equations."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from voxels import rays_to

import hiosdf_jax as hio
from hiosdf_jax._src.samples import from_cloud
from hiosdf_jax._src.samples.from_cloud import sample_cloud

CONFIG = hio.Config.light(
    ((-3, -3, -3), (3, 3, 3)), local_points=30, local_ray_samples=8, local_max_range=2.0
)
SENSOR = np.array([0.2, -0.1, 0.3], np.float32)


def cloud(count=700):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (SENSOR + directions * rng.uniform(0.5, 2.5, (count, 1))).astype(np.float32)


def test_brute_force_distance_against_a_tree():
    points, queries = cloud(), np.random.default_rng(1).uniform(-3, 3, (500, 3)).astype(np.float32)
    valid = np.arange(700) % 3 > 0
    exact, _ = cKDTree(points[valid].astype(np.float64)).query(queries)
    result = from_cloud.nearest_distance(
        jnp.asarray(queries), jnp.asarray(points), jnp.asarray(valid)
    )
    np.testing.assert_allclose(result, exact, atol=1e-5)
    none = from_cloud.nearest_distance(
        jnp.asarray(queries), jnp.asarray(points), jnp.zeros(700, bool)
    )
    assert np.isinf(np.asarray(none)).all()


def test_tiles_do_not_change_the_distance(monkeypatch):
    points, queries = cloud() + 9, cloud(300)  # the padding of the last tile must not be nearer
    whole = from_cloud.nearest_distance(queries, jnp.asarray(points), np.ones(700, bool))
    for tile in (64, 256):  # neither divides the cloud
        monkeypatch.setattr(from_cloud, "_TILE", tile)
        tiled = from_cloud.nearest_distance(queries, jnp.asarray(points), np.ones(700, bool))
        np.testing.assert_array_equal(whole, tiled)


def test_samples_follow_equations_1_and_2():
    points = cloud()
    samples = sample_cloud(CONFIG, rays_to(points, SENSOR), jax.random.key(0))
    queries = np.asarray(samples.points_world, np.float64)
    exact, _ = cKDTree(points.astype(np.float64)).query(queries)
    np.testing.assert_allclose(np.abs(samples.sdf), exact, atol=1e-5)
    np.testing.assert_array_equal(samples.weight, exact < CONFIG.local_truncation)
    # Each ray of 8 samples ends in a point of the cloud nearer than local_max_range.
    rays = (queries - SENSOR).reshape(30, 8, 3)
    depth = np.linalg.norm(rays, axis=-1)
    directions = rays[:, -1] / depth[:, -1:]
    ends = points - SENSOR
    ranges = np.linalg.norm(ends, axis=1)
    cosine = directions @ (ends / ranges[:, None]).T
    chosen = np.argmax(cosine, axis=1)
    assert (cosine.max(axis=1) > 1 - 1e-5).all()
    assert (ranges[chosen] < 2.0).all()
    sign = np.where(depth < ranges[chosen][:, None], 1, -1)
    np.testing.assert_array_equal(np.sign(samples.sdf).reshape(30, 8), sign)
    assert (sign < 0).any()
    # One sample in each stratum up to the truncation distance behind the point.
    stratum = np.floor(8 * depth / (ranges[chosen] + CONFIG.local_truncation)[:, None])
    np.testing.assert_array_equal(stratum, np.tile(np.arange(8), (30, 1)))


def test_padding_changes_nothing():
    points = cloud()
    padded = np.concatenate([points, np.zeros((100, 3), np.float32)])
    a = sample_cloud(CONFIG, rays_to(points, SENSOR), jax.random.key(0))
    b = sample_cloud(CONFIG, rays_to(padded, SENSOR, np.arange(800) < 700), jax.random.key(0))
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)
    none = sample_cloud(CONFIG, rays_to(points, SENSOR, hit=False), jax.random.key(0))
    assert not np.asarray(none.weight).any()
    assert not np.isnan(np.asarray(none.points_world)).any()
