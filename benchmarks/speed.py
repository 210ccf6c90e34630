"""Time of one update and of each of its stages, on a real stream.

    python benchmarks/speed.py --stream ../shared/data/house_depth.npz --config paper

Every stage is compiled on its own and timed on the same state after `--frames` updates: the sum of
the stages need not equal the whole, which XLA compiles as one program. Medians over repeats, with
the 10th and 90th percentile; results are blocked on and the first runs left out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from hiosdf_jax import datasets, mapping
from hiosdf_jax.grid import distance, rays, sampling, surface
from hiosdf_jax.local import sample_local
from hiosdf_jax.network import training
from hiosdf_jax.samples import concatenate


def time_ms(function: Callable[..., Any], *arguments: Any, repeats: int = 20) -> dict[str, float]:
    """Median and spread of a function's time, compiled and warmed up."""
    compiled = jax.jit(function)
    for _ in range(2):
        jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return {
        "median": float(np.median(times)),
        "p10": float(np.percentile(times, 10)),
        "p90": float(np.percentile(times, 90)),
    }


def stage_times(path: Path, config_name: str, frames: int) -> dict[str, dict[str, float]]:
    """Times the stages on the state after some frames of a stream."""
    stream = datasets.NpzStream(path)
    extent = datasets.find_bounds(stream)
    config = getattr(hio.Config, config_name)(extent.bounds, max_range=extent.max_range)
    state = hio.init(config, jax.random.key(0))
    for k in tqdm(range(frames), desc="mapping"):
        state = hio.update(state, *stream[k])
    cloud, pose = stream[frames]
    padded = jnp.asarray(mapping._to_capacity(cloud, pose, config.max_points))
    pose = jnp.asarray(pose)
    finite = jnp.all(jnp.isfinite(padded), axis=-1)
    offsets_world = jnp.where(finite[:, None], padded, 0) @ pose[:3, :3].T
    ranges = surface.safe_norm(offsets_world)
    directions_world = offsets_world / jnp.maximum(ranges, 1e-6)[:, None]
    sensor_world = pose[:3, 3]
    points_world = sensor_world + offsets_world
    key = jax.random.key(1)

    def samples_of(grid: Any, points_world: Any) -> Any:
        return concatenate(
            sampling.sample_grid(config, grid, key),
            sample_local(config, points_world, finite, sensor_world, key),
        )

    samples = jax.jit(samples_of)(state.grid, points_world)
    queries = jax.random.uniform(key, (102_400, 3), minval=-2.0, maxval=2.0)
    grid, network = state.grid, state.network
    return {
        "update, whole": time_ms(mapping._update, state, padded, pose),
        "fusion": time_ms(
            lambda g, p: surface.fuse_hits(config, g, p, finite, sensor_world), grid, points_world
        ),
        "rays": time_ms(
            lambda g, d: rays.trace_rays(config, g, d, ranges, finite, finite, sensor_world),
            grid,
            directions_world,
        ),
        "fading": time_ms(lambda g: rays.fade_evidence(config, g, sensor_world), grid),
        "distance": time_ms(lambda g: distance.update_distances(config, g, sensor_world), grid),
        "grid samples": time_ms(lambda g: sampling.sample_grid(config, g, key), grid),
        "local samples": time_ms(
            lambda p: sample_local(config, p, finite, sensor_world, key), points_world
        ),
        "training": time_ms(
            lambda n, s: training.train(
                config, n, s, jnp.int32(config.epochs), jnp.float32(0.9), key
            ),
            network,
            samples,
        ),
        "sdf_and_grad, 102,400 points": time_ms(hio.sdf_and_grad, state, queries),
    }


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Time of an update.")
    parser.add_argument("--stream", type=Path, default=Path("../shared/data/house_depth.npz"))
    parser.add_argument("--config", default="light")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--output", type=Path, default=Path("hiosdf_output/speed.json"))
    arguments = parser.parse_args()
    stages = stage_times(arguments.stream, arguments.config, arguments.frames)
    device = jax.devices()[0].device_kind
    print(
        f"{arguments.stream.stem}, Config.{arguments.config}, {device}, jax {jax.__version__}; ms"
    )
    for name, spread in stages.items():
        print(f"{name:30} {spread['median']:8.2f}  ({spread['p10']:.2f} to {spread['p90']:.2f})")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "stream": arguments.stream.stem,
        "config": arguments.config,
        "device": device,
        "jax": jax.__version__,
        "stages_ms": stages,
    }
    arguments.output.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
