"""Endurance: thousands of updates of one small map, with its error and the memory of the process.

    python -m benchmarks.robustness.endurance --updates 10000

A noisy sensor walks in a box-shaped room. The map must not drift, and the process must not grow.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks import records
from hiosdf_jax._src.command.map_frames import return_freed_memory

_HALF = np.array([0.97, 0.78, 0.56])  # m, the room; not on faces of voxels
_NOISE = 0.01  # m
_RAYS = 300
_POINTS = 2000  # where the error is measured
_EVERY = 20  # updates between two measurements
_MOST_GROWTH, _MOST_ERROR = 0.02, 1.05


def endure(updates: int, seed: int = 0) -> dict[str, float]:
    """Updates one map many times.

    Args:
        updates: Number of updates, at least 200.
        seed: Source of all randomness.

    Returns:
        `memory_growth`: of the resident memory, from the end of the second tenth to the end.
        `error_second_cm`, `error_last_cm`: mean error in the second and the last tenth.
        `error_ratio`: the last tenth's over the second's.
        `memory_mb`: at the end.
        `update_ms`: mean.
    """
    rng = np.random.default_rng(seed)
    config = hio.Config.light(
        (tuple(-_HALF - 0.2), tuple(_HALF + 0.2)),
        max_points=_RAYS,
        max_range=5.0,
        distance_horizon=1.0,
        near_samples=400,
        far_samples=400,
        local_points=20,
        hidden_width=16,
        hidden_layers=1,
        batches=2,
    )
    state = hio.init(config, jax.random.key(seed))
    points = rng.uniform(-_HALF + 0.05, _HALF - 0.05, (_POINTS, 3)).astype(np.float32)
    exact = (_HALF - np.abs(points)).min(axis=-1)
    errors, memory = [], []
    start = time.perf_counter()
    for i in tqdm(range(updates), desc="enduring", unit="update", miniters=updates // 100):
        state = hio.update(state, *_frame(i, rng))
        if (i + 1) % _EVERY == 0:
            error = np.abs(np.asarray(hio.sdf(state, points)) - exact)
            errors.append(100 * float(error.mean()))
            memory.append(_resident_mb())
    if int(state.updates) != updates:
        raise RuntimeError(f"{int(state.updates)} of {updates} updates changed the map")
    tenth = len(errors) // 10
    second, last = np.mean(errors[tenth : 2 * tenth]), np.mean(errors[-tenth:])
    return {
        "updates": updates,
        "memory_growth": memory[-1] / memory[2 * tenth - 1] - 1,
        "memory_mb": memory[-1],
        "error_second_cm": float(second),
        "error_last_cm": float(last),
        "error_ratio": float(last / second),
        "update_ms": 1000 * (time.perf_counter() - start) / updates,
    }


def _frame(i: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noisy returns of a sensor on a closed walk, and its pose."""
    angle = 0.05 * i
    position = [0.4 * np.cos(angle), 0.3 * np.sin(angle), 0.2 * np.sin(0.7 * angle)]
    rays = rng.normal(size=(_RAYS, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pose = np.eye(4)
    cos, sin = np.cos(0.3 * i), np.sin(0.3 * i)
    pose[:2, :2], pose[:3, 3] = [[cos, -sin], [sin, cos]], position
    world = rays @ pose[:3, :3].T
    ranges = ((_HALF * np.sign(world) - position) / world).min(axis=1)
    return rays * (ranges + _NOISE * rng.normal(size=_RAYS))[:, None], pose


def _resident_mb() -> float:
    gc.collect()
    return_freed_memory()  # what compiling has freed would hide a leak
    pages = int(Path("/proc/self/statm").read_text("utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Runs the endurance test; returns 1 if a figure misses its bar."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness.endurance")
    parser.add_argument("--updates", type=int, default=10_000, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--output", type=Path, default=Path("hiosdf_output/endurance.json"), metavar="FILE"
    )
    options = parser.parse_args()
    figures = endure(options.updates, options.seed)
    records.write(options.output, records.provenance() | {"figures": figures})
    for name, value in figures.items():
        print(f"{name:16s} {value:.4g}")
    met = figures["memory_growth"] <= _MOST_GROWTH and figures["error_ratio"] <= _MOST_ERROR
    print("both bars met" if met else "a bar is MISSED", end=": ")
    print(f"memory growth <= {_MOST_GROWTH}, error ratio <= {_MOST_ERROR}")
    return int(not met)


if __name__ == "__main__":
    sys.exit(main())
