"""Calibration of the lower bound on the returns of the newest cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF, ask
from voxels import rays_to

import hiosdf_jax as hio
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.mapping import calibration
from hiosdf_jax._src.mapping.calibration import calibrate_bound


@pytest.fixture
def field(room_map):
    """A map that has learned nothing about its bound."""
    return hio.snapshot(room_map).replace(updates=jnp.int32(0), optimism=jnp.float32(9))


def test_calibration_follows_the_quantile_of_the_newest_returns(field, monkeypatch):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (5000, 3)).astype(np.float32)
    seen = np.concatenate([ask(field, part).observed for part in np.split(points, 5)])

    def known(field, points):
        """A ratio of x + offset; the offset is that of an argument: one compilation."""
        offset = field.stamp
        return (points[:, 0] + offset) * 0.5, jnp.full(len(points), 0.5)

    offset = 1.0
    field = field.replace(stamp=jnp.float32(offset))
    # Only now: `query` must not be compiled with it.
    monkeypatch.setattr(blend, "cautious_sdf", known)
    assert seen.mean() > 0.5
    sensor = np.array([0.3, 0.0, 0.0], np.float32)
    # A return stands for a piece of surface that grows with its range squared.
    area = np.sum((points - sensor) ** 2, axis=1)[seen]
    ordered = np.argsort(points[:, 0][seen])
    share = np.cumsum(area[ordered]) / area.sum()
    expected = offset + float(points[:, 0][seen][ordered][np.argmax(share >= 0.945)])

    compiled = jax.jit(lambda *arguments: calibrate_bound(*arguments))

    def calibrate(field, ends):
        return float(compiled(field, rays_to(points, sensor, ends), jax.random.key(0)))

    every = np.ones(5000, bool)
    assert abs(calibrate(field, every) - expected) < 0.02
    later = field.replace(updates=jnp.int32(1000))
    assert abs(calibrate(later, every) - (0.98 * 9 + 0.02 * expected)) < 0.01
    assert calibrate(field, ~seen) == 9
    assert calibrate(field, np.zeros(5000, bool)) == 9
    few = seen & (np.cumsum(seen) <= 1)  # drawn 5,000 times, which is enough
    assert calibrate(field, few) != 9
    # The map agrees with all returns, and free space still needs some margin.
    agrees = field.replace(stamp=jnp.float32(-1))
    assert calibrate(agrees, every) == pytest.approx(calibration._LEAST)


def test_too_few_observed_returns_calibrate_nothing(field):
    known = np.random.default_rng(0).uniform(-HALF, HALF, (2000, 3)).astype(np.float32)
    points = np.where(np.arange(2000)[:, None] % 40 == 0, known, 0.999 * np.array(CONFIG.bounds[1]))
    seen = ask(field, points).observed
    assert 0 < seen.sum() < 60  # of 2,000 that are drawn with replacement
    rays = rays_to(points, np.zeros(3))
    assert float(jax.jit(calibrate_bound)(field, rays, jax.random.key(0))) == 9
