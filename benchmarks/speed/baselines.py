"""The work of some rows, done by other libraries in the same process on the same data."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks.speed.rows import Baseline, Spread, time_ms
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.network import forward
from hiosdf_jax._src.samples.draw import Samples
from hiosdf_jax._src.state.pytrees import Network


def training(config: Config, network: Network, samples: Samples, seconds: float) -> list[Baseline]:
    """Times the paper's training: every sample with its slope, all samples in each step."""
    epochs = config.epochs
    label = f"PyTorch eager, {epochs} epochs of {samples.sdf.size:,}"

    def measure(torch: Any, siren: Any, device: str) -> Spread:
        model = _model(siren, config, network.params).to(device)
        steps = siren.optimizer(model, config.learning_rate, config.weight_decay)
        weights = config.sdf_weight, config.eikonal_weight
        inputs = samples.points_world - network.origin_world, samples.sdf, samples.weight
        tensors = tuple(torch.tensor(np.asarray(array), device=device) for array in inputs)
        return time_ms(
            lambda: siren.train(model, steps, epochs, tensors, weights),
            seconds=seconds,
            block=_blocking(torch, device),
        )

    return _by_torch(label, measure)


def network_query(
    config: Config, network: Network, points: jax.Array, seconds: float
) -> list[Baseline]:
    """Times values and gradients of the paper's network at points relative to its origin."""

    def measure(torch: Any, siren: Any, device: str) -> Spread:
        model = _model(siren, config, network.average).to(device)
        tensor = torch.tensor(np.asarray(points), device=device)
        return time_ms(
            lambda: siren.value_and_gradient(model, tensor),
            seconds=seconds,
            block=_blocking(torch, device),
        )

    return _by_torch("PyTorch eager, the paper's network", measure)


def nearest(queries: np.ndarray, points: np.ndarray, seconds: float) -> list[Baseline]:
    """Times distances to the nearest point of a new cloud, the building of its tree included."""

    def measure(spatial: Any) -> Spread:
        return time_ms(lambda: spatial.cKDTree(points).query(queries, workers=-1), seconds=seconds)

    return _by_scipy("scipy cKDTree on the CPU, built and queried", "spatial", measure)


def distance(features: np.ndarray, doubtful: np.ndarray, seconds: float) -> list[Baseline]:
    """Times the search for feature voxels and for doubtful ones in the same window."""
    return _by_transforms(
        "twice", lambda edt: (edt(~features, return_indices=True), edt(~doubtful)), seconds
    )


def frontier(observed: np.ndarray, seconds: float) -> list[Baseline]:
    """Times distances from observed voxels to unobserved ones and back in the same window."""
    return _by_transforms("both ways", lambda edt: (edt(observed), edt(~observed)), seconds)


def _by_transforms(how: str, transforms: Callable[[Any], Any], seconds: float) -> list[Baseline]:
    """Times a function of scipy's exact distance transform."""

    def measure(ndimage: Any) -> Spread:
        return time_ms(lambda: transforms(ndimage.distance_transform_edt), seconds=seconds)

    return _by_scipy(f"scipy distance_transform_edt on the CPU, {how}", "ndimage", measure)


def _by_torch(label: str, measure: Callable[[Any, Any, str], Spread]) -> list[Baseline]:
    """Times in float32 and, on a GPU, with TF32 products too."""
    try:
        torch = importlib.import_module("torch")
        siren = importlib.import_module("benchmarks.speed.torch_siren")
    except ImportError as error:
        return [Baseline(label, None, str(error))]
    on_gpu = jax.default_backend() == "gpu" and torch.cuda.is_available()
    device = "cuda" if on_gpu else "cpu"
    found = []
    for name, precision in (("fp32", "highest"), ("TF32", "high"))[: 2 if on_gpu else 1]:
        torch.set_float32_matmul_precision(precision)
        full = f"{label}, {name}" + ("" if on_gpu else " on the CPU")
        try:
            found.append(Baseline(full, measure(torch, siren, device)))
        except Exception as error:
            found.append(Baseline(full, None, f"{type(error).__name__}: {error}"))
    torch.set_float32_matmul_precision("highest")
    if on_gpu:
        torch.cuda.empty_cache()
    return found


def _by_scipy(label: str, module: str, measure: Callable[[Any], Spread]) -> list[Baseline]:
    try:
        return [Baseline(label, measure(importlib.import_module(f"scipy.{module}")))]
    except ImportError as error:
        return [Baseline(label, None, str(error))]


def _model(siren: Any, config: Config, params: Any) -> Any:
    layers = [(np.asarray(k), np.asarray(b)) for k, b in forward.layers_of(params)]
    return siren.Siren(layers, config.frequency)


def _blocking(torch: Any, device: str) -> Callable[[Any], Any]:
    return lambda _: torch.cuda.synchronize() if device == "cuda" else None
