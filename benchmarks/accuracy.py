"""Accuracy on streams with exact ground truth: the grid alone and the network, beside the peers.

    python benchmarks/accuracy.py --data ../shared/data --streams house_depth --configs light

Prints a table a stream and writes every figure, with seed and configuration, to a JSON file.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from hiosdf_jax import datasets
from hiosdf_jax.evaluation import evaluate, format_table
from hiosdf_jax.grid.lookup import grid_sdf_and_grad


def score_stream(path: Path, config_name: str, seed: int) -> dict[str, Any]:
    """Maps a stream and scores the grid alone and the network after the last frame."""
    stream = datasets.NpzStream(path)
    truth = datasets.ground_truth(path)
    if truth is None:
        raise ValueError(f"{path} has no eval_* arrays to score against")
    extent = datasets.find_bounds(stream)
    config = getattr(hio.Config, config_name)(extent.bounds, max_range=extent.max_range)
    state = hio.init(config, jax.random.key(seed))
    times_ms = []
    pose = np.eye(4)
    for frame in tqdm(range(len(stream)), desc=f"{path.stem} {config_name} seed {seed}"):
        cloud, pose = stream[frame]
        start = time.perf_counter()
        state = jax.block_until_ready(hio.update(state, cloud, pose))
        times_ms.append(1e3 * (time.perf_counter() - start))
    query = jax.jit(hio.sdf_and_grad)
    grid_query = jax.jit(lambda state, points: grid_sdf_and_grad(state.config, state.grid, points))
    sensor_world = pose[:3, 3]
    return {
        "stream": path.stem,
        "config": dataclasses.asdict(config),
        "config_name": config_name,
        "seed": seed,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "compile_and_first_update_ms": times_ms[0],
        "update_ms": {
            "median": float(np.median(times_ms[1:])),
            "p10": float(np.percentile(times_ms[1:], 10)),
            "p90": float(np.percentile(times_ms[1:], 90)),
        },
        "grid": evaluate(lambda points: grid_query(state, points), truth, sensor_world),
        "network": evaluate(lambda points: query(state, points), truth, sensor_world),
    }


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description="Accuracy on streams.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--streams", nargs="+", default=["house_depth", "house_lidar"])
    parser.add_argument("--configs", nargs="+", default=["light"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--output", type=Path, default=Path("hiosdf_output/accuracy.json"))
    arguments = parser.parse_args()
    peers_file = arguments.data / "peers.json"
    peers = json.loads(peers_file.read_text()) if peers_file.exists() else {}
    results = []
    for stream in arguments.streams:
        for config_name in arguments.configs:
            for seed in arguments.seeds:
                result = score_stream(arguments.data / f"{stream}.npz", config_name, seed)
                results.append(result)
                print(
                    f"\n{stream}, Config.{config_name}, seed {seed}: update {result['update_ms']}"
                )
                print("grid alone:")
                print(format_table(result["grid"]))
                print("network (what is served):")
                print(format_table(result["network"], peers.get(stream)))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
