"""What is compiled for a GPU, run on a CPU: other loops and tiles, the same map."""

import jax
import numpy as np
from room import CONFIG, stream

import hiosdf_jax as hio
from hiosdf_jax._src.grid import carving
from hiosdf_jax._src.mapping import pipeline


def last_of(update, frames):
    """The map after some frames."""
    state = hio.init(CONFIG, jax.random.key(0))
    for cloud, pose in frames:
        state = update(state, hio.pad_cloud(CONFIG, cloud), pose, None, None, np.uint32(0))
    return jax.device_get(state)


def test_a_gpu_maps_what_a_cpu_maps(monkeypatch):
    """The walls come nearer after some frames, so that surfaces appear and vanish."""
    frames = stream(7)
    frames[4:] = [(0.6 * cloud, pose) for cloud, pose in frames[4:]]
    expected = last_of(pipeline._update_jit, frames)
    monkeypatch.setattr(carving, "_CHUNK", 4)
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: asked.append(1) or "gpu")
    found = last_of(jax.jit(lambda *arguments: pipeline._update(*arguments)), frames)
    assert asked
    for old, new in zip(jax.tree.leaves(expected.grid), jax.tree.leaves(found.grid), strict=True):
        np.testing.assert_array_equal(new, old)
    assert found.report.update_flags == expected.report.update_flags
    np.testing.assert_allclose(found.report.sdf_loss, expected.report.sdf_loss, rtol=1e-3)
