"""The command: scenarios measured, laid out as tables, and compared with bars and baseline."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import records
from benchmarks.robustness import apartment, changes, faults, figures, gate, movers
from benchmarks.robustness.library import Setup
from benchmarks.robustness.measures import Figures

Scenario = Callable[[Setup], dict[str, Figures]]

_TABLES = records.RESULTS / "robustness.json"


def scenarios(data: Path) -> dict[str, Scenario]:
    """All scenarios by name.

    Args:
        data: Folder where house_depth.npz may be.
    """
    return {
        "stand": changes.stand,
        "appear": changes.appear,
        "jump": changes.jump,
        "cross": movers.cross,
        "walk": movers.walk,
        "arm": movers.arm,
        "apartment": apartment.visit,
        "apartment_arm": apartment.arm,
        "faults": partial(faults.run_faults, folder=data),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: Those after the command's name; by default those of the process.

    Returns:
        The exit code: 1 if a figure is worse than in the baseline or, with --bars, misses its bar.
    """
    options = _parser().parse_args(arguments)
    groups: dict[str, figures.Results] = {}
    record: dict[str, Any] = records.provenance() | {"seeds": options.seeds, "rows": {}}
    chosen = scenarios(options.data)
    for name in options.only or chosen:
        group = groups.setdefault(name, {})
        for seed in options.seeds:
            for row, measured in chosen[name](Setup(options.config, seed)).items():
                for figure, value in measured.items():
                    group.setdefault(row, {}).setdefault(figure, []).append(value)
        print(figures.format_tables({name: group}) + "\n", flush=True)
        record["rows"] |= group
        records.write(options.output, {options.config: record})
    print(f"wrote {options.output}")

    rows = record["rows"]
    checks = figures.check(rows)
    missed = [each for each in checks if not each.met]
    print(
        f"{len(checks) - len(missed)} of {len(checks)} bars met; ! marks a figure that misses its"
    )
    if options.bars:
        for each in missed:
            print(f"  MISSED {each.row}: {each.bar.figure} {each.value:.3g}", end="")
            print(f", expected {each.bar.least:.3g} to {each.bar.most:.3g}")
    if options.update_tables:
        gate.update_means(_TABLES, options.config, record)
        print(f"wrote {_TABLES}")
    if options.update_baseline:
        gate.update_baseline(options.baseline, options.config, record)
        print(f"wrote {options.baseline}")
        return int(options.bars and bool(missed))
    old = records.read(options.baseline).get(options.config, {"rows": {}})["rows"]
    verdict = gate.compare(old, rows)
    for heading, lines in (
        ("better than the baseline (--update-baseline takes it over)", verdict.better),
        ("WORSE than the baseline", verdict.worse),
    ):
        if lines:
            print(f"\n{heading}:\n" + "\n".join(f"  {line}" for line in lines))
    print(f"{verdict.compared} figures compared with {options.baseline}")
    return int(bool(verdict.worse) or (options.bars and bool(missed)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.robustness",
        description="Worlds that change, things that move, sensors that lie; exit code 1 if a "
        "figure is worse than in the baseline.",
    )
    parser.add_argument(
        "--only", nargs="+", choices=scenarios(Path()), metavar="NAME", help="default: all"
    )
    parser.add_argument("--config", default="light", choices=("light", "default", "paper"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="SEED")
    parser.add_argument(
        "--data",
        type=Path,
        default=Path("../shared/data"),
        metavar="DIR",
        help="folder of house_depth.npz; without it faults are injected into scans of a room",
    )
    parser.add_argument("--bars", action="store_true", help="fail if a figure misses its bar")
    parser.add_argument("--baseline", type=Path, default=gate.BASELINE, metavar="FILE")
    parser.add_argument(
        "--update-baseline", action="store_true", help="write the figures into the baseline"
    )
    parser.add_argument(
        "--update-tables",
        action="store_true",
        help="write the figures that the documents show into their record",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("hiosdf_output/robustness.json"),
        metavar="FILE",
        help="all figures (default: %(default)s)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
