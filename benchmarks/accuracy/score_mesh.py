"""Scores the mesh of another system, with the code that scores ours."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import trimesh

from benchmarks.accuracy.measure import draw_held_out
from benchmarks.accuracy.sources import open_source
from hiosdf_jax import Config, scoring


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.score_mesh")
    parser.add_argument("stream", help="house_depth, for example")
    parser.add_argument("mesh", type=Path, help="m, world frame of the stream")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    options = parser.parse_args()

    mesh = trimesh.load_mesh(options.mesh, process=False)
    source = open_source(options.data, options.stream)
    if source.truth is None:
        config = Config.light(source.extent.bounds, max_range=source.extent.max_range)
        scores = scoring.evaluate_held_out_mesh(mesh, draw_held_out(source.stream, config))
    else:
        scores = scoring.evaluate_mesh(mesh, source.truth, source.distance)
    print(json.dumps(scores, indent=2))


if __name__ == "__main__":
    main()
