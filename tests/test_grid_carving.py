"""Passes of rays and hidden voxels against a loop over the steps of each ray."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from voxels import CONFIG, SHAPE, empty_window, rays_to, trace, uniform

from hiosdf_jax._src.grid import carving


@pytest.mark.parametrize("hit", [True, False])
def test_rays_against_a_loop(hit):
    sensor = np.array([0.31, 0.52, 0.63])
    ends = uniform(7, 40, (-0.8, -0.4, 0.0), (1.4, 1.4, 1.2)).astype(np.float64)
    window = trace(empty_window(), ends, sensor, hit)
    passes, behind = np.zeros(SHAPE), np.zeros(SHAPE)
    phases = np.asarray(carving._phases(40), np.float64)
    for end, phase in zip(ends, phases, strict=True):
        length = np.linalg.norm(end - sensor) / 0.1
        direction = (end - sensor) / length
        steps = [k + phase for k in range(100) if k + phase < length - (1 if hit else 0)]
        hidden = [length + 0.5 + k + phase for k in range(3)] if hit else []
        for array, along in ((passes, steps), (behind, hidden)):
            for t in along:
                cell = np.floor((sensor + t * direction) / 0.1).astype(int) - CONFIG.corner_index
                if np.all((cell >= 0) & (cell < SHAPE)):
                    array[tuple(cell)] += 1
    # A step that falls on a face of a voxel may be rounded to either side.
    assert np.abs(np.asarray(window.passes) - passes).sum() <= 4
    assert np.abs(np.asarray(window.behind) - behind).sum() <= 2
    assert passes.sum() > 100


@pytest.mark.parametrize(
    ("device", "most_chunks"), [("cpu", 16), ("gpu", 100), ("gpu", 1)], ids=str
)
def test_a_long_ray_does_not_depend_on_the_steps_per_iteration(monkeypatch, device, most_chunks):
    """With a range that is as long as the longest ray."""
    ends, sensor = uniform(7, 40, (0.1, 0.1, 0.3), (0.9, 0.9, 0.9)), np.array([0.0, 0.0, 0.25])
    rays = rays_to(ends, sensor)
    longest_m = float(np.max(rays.free_ranges))
    config = dataclasses.replace(CONFIG, voxel_size=0.02, max_range=longest_m)
    assert longest_m / 0.02 > 60

    def compiled_anew():
        return jax.jit(functools.partial(carving.trace_rays, config))(empty_window(config), rays)

    once = compiled_anew()
    monkeypatch.setattr(carving, "_MOST_CHUNKS", most_chunks)
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    for chunk in (5, 100):
        monkeypatch.setattr(carving, "_CHUNK", chunk)
        np.testing.assert_array_equal(compiled_anew().passes, once.passes)
    longest = np.sum(np.asarray(rays.free_ranges) / 0.02 - 1)
    assert abs(float(once.passes.sum()) - longest) < len(ends)


def test_a_hidden_voxel_that_rays_pass_again_is_observed():
    sensor, ends = np.array([0.31, 0.52, 0.63]), uniform(7, 40)
    old = np.random.default_rng(0).integers(-9, 10, SHAPE)
    window = empty_window()._replace(passes=jnp.asarray(old, jnp.float32))
    new = np.asarray(trace(empty_window(), ends, sensor).passes)
    assert np.sum((new > 0) & (old < 0)) > 10 < np.sum((new == 0) & (old < 0))
    expected = np.where(new > 0, np.abs(old) + new, old)
    np.testing.assert_array_equal(trace(window, ends, sensor).passes, expected)
