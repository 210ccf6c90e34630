"""The command: scenarios measured, laid out as tables, and compared."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.robustness import changes, faults, movers
from benchmarks.robustness.library import Setup

SCENARIOS = {
    "appear": changes.appear,
    "jump": changes.jump,
    "cross": movers.cross,
    "walk": movers.walk,
    "arm": movers.arm,
    "faults": lambda setup: faults.faults(setup, Path("../shared/data")),
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--config", default="light", choices=("light", "default", "paper"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="SEED")
    parser.add_argument(
        "--output", type=Path, default=Path("hiosdf_output/robustness.json"), metavar="FILE"
    )
    options = parser.parse_args(arguments)
    rows: dict[str, dict[str, float]] = {}
    for name in options.only:
        for seed in options.seeds:
            for row, figures in SCENARIOS[name](Setup(options.config, seed)).items():
                rows[f"{row} (seed {seed})" if len(options.seeds) > 1 else row] = figures
        for row, figures in rows.items():
            print(row, {k: round(v, 3) for k, v in figures.items()})
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
