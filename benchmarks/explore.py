"""Runs the exploring robot over many seeds, each in its own process.

    python -m benchmarks.explore --seeds 20 --output explore.json

It counts reached goals and collisions, and measures the wall time of the whole command, including
start, compilation and drawing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import records


def run(seed: int, folder: Path) -> dict:
    """Runs `hiosdf demo --plan` once."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "hiosdf_jax", "demo", "--plan", "--seed", str(seed)]
    done = subprocess.run([*command, "--output", str(folder)], capture_output=True, text=True)
    seconds = time.perf_counter() - begin
    if done.returncode not in (0, 1):
        raise RuntimeError(done.stderr)
    return json.loads((folder / "metrics.json").read_text("utf-8")) | {"command_s": seconds}


def summarize(runs: list[dict]) -> dict:
    """Counts outcomes and extremes over runs."""
    return {
        "runs": len(runs),
        "reached": sum(r["reached"] for r in runs),
        "collided": sum(r["collided"] for r in runs),
        "least_clearance_m": min(r["least_clearance_m"] for r in runs),
        "median_path_m": float(np.median([r["path_m"] for r in runs])),
        "longest_command_s": max(r["command_s"] for r in runs),
        "median_command_s": float(np.median([r["command_s"] for r in runs])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="The exploring robot over many seeds.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--folder", type=Path, help="folder to keep pictures and metrics in")
    options = parser.parse_args()
    runs = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(options.first, options.first + options.seeds):
            runs.append(run(seed, (options.folder or Path(scratch)) / f"seed_{seed}"))
            shown = ("seed", "from", "to", "reached", "collided", "least_clearance_m", "path_m")
            print({key: runs[-1][key] for key in (*shown, "command_s")}, flush=True)
    summary = summarize(runs)
    print(json.dumps(summary))
    if options.output:
        records.write(options.output, records.provenance() | summary | {"each": runs})


if __name__ == "__main__":
    main()
