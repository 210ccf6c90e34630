"""Times clearances of many spheres with gradients by baked field, field and network.

    python -m benchmarks.planning                  # 1,048,576 spheres: a GPU
    python -m benchmarks.planning --count 65536    # two CPU cores

The calls take turns, so that other load on the machine affects them alike. Times and ratios to the
baked field are medians with the 10th and 90th percentile over the turns, without compilation and
the first turns. `blended` is the field itself, grid and network combined. `swept` is the swept
clearance of as many spheres on the baked field, without gradient. All of them use the policy
`unknown="network"`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.variants import VARIANTS
from hiosdf_jax import datasets, demo, planning

RADIUS = 0.1  # m
MOTION = 0.05  # m, the length of a swept motion
WARMUP_TURNS = 2


def make_field(config_name: str, stream_path: Path | None, frames: int) -> hio.Field:
    """Maps the first frames of a stream, by default of the demo's apartment."""
    if stream_path is None:
        stream, bounds, max_range = demo.ApartmentStream(frames=frames), demo.BOUNDS_WORLD, 6.0
    else:
        stream = datasets.NpzStream(stream_path)
        extent = datasets.find_bounds(stream)
        bounds, max_range = extent.bounds, extent.max_range
    config = getattr(hio.Config, config_name)(bounds, max_range=max_range)
    state = hio.init(config, jax.random.key(0))
    for k in tqdm(range(min(frames, len(stream))), desc="mapping"):
        state = hio.update(state, *stream[k])
    return hio.snapshot(state)


def network_clearance_and_grad(
    field: hio.Field, centers_world: jax.Array, radii: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes `sphere_clearance_and_grad` by the network alone."""
    value, gradient = VARIANTS["network"](field, centers_world)
    return value - radii, gradient


def take_turns(calls: dict[str, Callable[[], Any]], turns: int) -> dict[str, np.ndarray]:
    """Times the calls one after the other in each turn, (turns,) ms each."""
    times = {name: [] for name in calls}
    for turn in tqdm(range(-WARMUP_TURNS, turns), desc="timing"):
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            elapsed = 1e3 * (time.perf_counter() - start)
            if turn >= 0:
                times[name].append(elapsed)
    return {name: np.array(values) for name, values in times.items()}


def measure(field: hio.Field, count: int, resolution: float, turns: int) -> dict[str, Any]:
    """Times the calls on the same spheres."""
    baked = hio.bake(field, resolution)
    low, high = jnp.asarray(field.config.bounds, jnp.float32)
    center_key, way_key = jax.random.split(jax.random.key(1))
    centers = jax.random.uniform(center_key, (count, 3), minval=low, maxval=high)
    way = jax.random.normal(way_key, (count, 3))
    ends = centers + MOTION * way / jnp.linalg.norm(way, axis=-1, keepdims=True)
    radii = jnp.full(count, RADIUS)
    clearance = jax.jit(partial(planning.sphere_clearance_and_grad, unknown="network"))
    network = jax.jit(network_clearance_and_grad)
    swept = jax.jit(partial(planning.swept_clearance, unknown="network"))
    times = take_turns(
        {
            "baked": lambda: clearance(baked, centers, radii),
            "blended": lambda: clearance(field, centers, radii),
            "network": lambda: network(field, centers, radii),
            "swept": lambda: swept(baked, centers, ends, radii),
        },
        turns,
    )
    return {
        "baked_shape": list(baked.sdf.shape),
        "times_ms": {name: records.percentiles(values) for name, values in times.items()},
        "ratios_to_baked": {
            name: records.percentiles(times[name] / times["baked"])
            for name in times
            if name != "baked"
        },
    }


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Times of sphere clearances and their ratios.")
    parser.add_argument("--count", type=int, default=1_048_576, help="number of spheres")
    parser.add_argument("--config", default="default")
    parser.add_argument("--stream", type=Path, help=".npz file (default: the demo's apartment)")
    parser.add_argument("--frames", type=int, default=10, help="frames mapped before the timing")
    parser.add_argument(
        "--resolution", type=float, default=0.05, help="resolution of the baked field, m"
    )
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("hiosdf_output/planning.json"))
    arguments = parser.parse_args()
    field = make_field(arguments.config, arguments.stream, arguments.frames)
    record = {
        "count": arguments.count,
        "stream": arguments.stream.stem if arguments.stream else "demo apartment",
        "frames": arguments.frames,
        "config": arguments.config,
        "resolution_m": arguments.resolution,
        "turns": arguments.turns,
    }
    record |= records.provenance()
    record |= measure(field, arguments.count, arguments.resolution, arguments.turns)
    print(f"{arguments.count} spheres, Config.{arguments.config}, {record['device']}")
    for name, times in record["times_ms"].items():
        ratio = record["ratios_to_baked"].get(name)
        line = f"{name:8} {times['median']:9.2f} ms ({times['p10']:.2f} to {times['p90']:.2f})"
        if ratio:
            line += f"  {ratio['median']:.1f} x baked ({ratio['p10']:.1f} to {ratio['p90']:.1f})"
        print(line)
    records.write(arguments.output, record)


if __name__ == "__main__":
    main()
