"""What the network adds in unseen space, and how compact it is.

    python -m benchmarks.accuracy.unseen

The first 20 frames of house_depth are mapped. The distance is judged at points that the map has not
seen, and that later frames see.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import trange

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.accuracy.sources import open_source
from benchmarks.variants import VARIANTS
from hiosdf_jax._src.state.pytrees import field_of
from hiosdf_jax.datasets import GroundTruth

RECORD = records.RESULTS / "unseen.json"
_FRAMES = 20
DEPTHS_M = (0.0, 0.25, 0.5, 1.0)  # distances to observed space


def score_unseen(state: hio.MapState, truth: GroundTruth) -> list[dict[str, Any]]:
    """Scores the parts of a map at points that it has not seen.

    Args:
        state: A map.
        truth: Points of free space with exact distances.

    Returns:
        For each interval of `DEPTHS_M` the number of `points` and, by variant, the mean error, cm.
    """
    points = truth.points_world.astype(np.float32)
    depth = -np.asarray(hio.query(state, points).frontier)
    found = {
        name: np.asarray(answer(field_of(state), points)[0]) for name, answer in VARIANTS.items()
    }
    rows = []
    for low, high in itertools.pairwise(DEPTHS_M):
        chosen = (depth > low) & (depth <= high)
        errors = {
            name: records.rounded(100 * float(np.mean(np.abs(sdf - truth.sdf)[chosen])), 4)
            for name, sdf in found.items()
        }
        rows.append({"points": int(chosen.sum()), "error_cm": errors})
    return rows


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.unseen")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument("--config", default="light", choices=("light", "default", "paper"))
    parser.add_argument("--output", type=Path, metavar="FILE", help="write a record")
    options = parser.parse_args()
    source = open_source(options.data, "house_depth")
    if source.truth is None:
        parser.error("needs house_depth.npz")
    preset = getattr(hio.Config, options.config)
    config = preset(source.extent.bounds, max_range=source.extent.max_range)
    state = hio.init(config, jax.random.key(0))
    for frame in trange(_FRAMES, desc="mapping", unit="frame"):
        state = hio.update(state, *source.stream[frame])
    rows = score_unseen(state, source.truth)
    sizes = {
        name: records.rounded(1e-6 * sum(leaf.nbytes for leaf in jax.tree.leaves(part)), 3)
        for name, part in (("network", field_of(state).params), ("grid", state.grid))
    }
    print(rows, sizes)
    if options.output:
        record = records.read(options.output)
        entry = records.provenance() | {"rows": rows, "mb": sizes}
        records.write(options.output, record | {options.config: entry})


if __name__ == "__main__":
    main()
