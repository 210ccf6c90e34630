"""The SIREN and its gradient in numpy and float64, samples, and GPU kernels on a CPU."""

import jax.numpy as jnp
import numpy as np
import pytest

import hiosdf_jax as hio
from hiosdf_jax._src.network import evaluation, loss
from hiosdf_jax._src.numerics import devices
from hiosdf_jax._src.samples.draw import Samples

BOUNDS = ((-1, -1, -1), (1, 1, 1))
TINY = hio.Config.light(BOUNDS, hidden_width=8, hidden_layers=1, batches=1, eikonal_every=1)


def mean_losses(config, params, points, samples):
    """The means of both losses over the samples with weight."""
    weights = loss.weights(config, samples)
    return loss.means(loss.sums(config, params, points, samples), weights)


def numpy_forward(config, params, points):
    layers = [params["params"][f"Dense_{k}"] for k in range(config.hidden_layers + 2)]
    x = np.asarray(points, np.float64)
    for layer in layers[:-1]:
        z = x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        x = np.sin(config.frequency * z)
    last = layers[-1]
    return (x @ np.asarray(last["kernel"], np.float64) + np.asarray(last["bias"], np.float64))[:, 0]


def numpy_gradient(config, params, points, step=1e-5):
    points = np.asarray(points, np.float64)
    return np.stack(
        [
            (
                numpy_forward(config, params, points + step * axis)
                - numpy_forward(config, params, points - step * axis)
            )
            / (2 * step)
            for axis in np.eye(3)
        ],
        axis=-1,
    )


def some_samples(count=64, seed=0):
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)
    return Samples(
        jnp.asarray(points),
        jnp.asarray(0.5 - np.linalg.norm(points, axis=1), jnp.float32),
        jnp.asarray(np.arange(count) % 5 > 0, jnp.float32),
    )


def interpret_kernels(monkeypatch, multiprocessors):
    """Runs kernels for Hopper GPUs on the CPU."""
    mosaic = pytest.importorskip("jax.experimental.pallas.mosaic_gpu")
    if not hasattr(mosaic, "InterpretGPUParams"):
        pytest.skip("this jax cannot interpret GPU kernels")
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    monkeypatch.setattr(evaluation, "INTERPRET", mosaic.InterpretGPUParams())
    monkeypatch.setattr(evaluation, "multiprocessors", lambda: multiprocessors)
