"""The command that measures, compares and draws streams x configurations x seeds."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks import records
from benchmarks.accuracy import figure, gate, results
from benchmarks.accuracy.measure import measure_source
from benchmarks.accuracy.sources import open_source
from hiosdf_jax import Config

_BASELINE = records.RESULTS / "accuracy_baseline.json"
_TABLES = records.RESULTS / "accuracy.json"

_BATCHES = {"batches": 8, "learning_rate": 1e-4}

# {table: {row: fields of the configuration that it changes}}
ABLATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "stages": {
        "as it is": {},
        "no carving": {"min_hit_ratio": 0.0},
        "one local ray": {"local_points": 1},
        "no Eikonal loss": {"eikonal_weight": 0.0},
        "last weights": {"weight_average": 0.0},
        "network alone": {"grid_share": 0.0},
        "grid alone": {"grid_share": 1.0},
    },
    # The paper's samples and epochs: with --configs paper.
    "training": {
        "as it is": {},
        "8 batches": _BATCHES,
        "Eikonal weight 0.5": {"eikonal_weight": 0.5},
        "both": _BATCHES | {"eikonal_weight": 0.5},
        "both, average 0.8": _BATCHES | {"eikonal_weight": 0.5, "weight_average": 0.8},
    },
    "voxel_size": {f"{edge} m": {"voxel_size": edge} for edge in (0.05, 0.1, 0.2)},
    "grid_share": {f"{share}": {"grid_share": share} for share in (0.0, 0.5, 0.8, 0.9, 1.0)},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: Those after the command's name; those of the process if left out.

    Returns:
        The exit code, 1 if a figure is worse than in the baseline.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    overrides = dict(options.override)
    table = ABLATIONS[options.ablation] if options.ablation else {"": {}}
    if options.update_baseline and (overrides or options.ablation):
        parser.error("--update-baseline is for configurations as they are")
    try:
        for changes in table.values():
            Config.light(((0, 0, 0), (1, 1, 1)), **(overrides | changes))
    except ValueError as error:
        parser.error(str(error))
    missing = [
        path
        for path in (options.data / f"{name}.npz" for name in options.streams if name != "demo")
        if not path.is_file()
    ]
    if missing:
        parser.error(f"{missing[0]}: no such file")

    groups, peers = _measure(options, table)
    runs = [run for group in groups.values() for run in group]
    print("\n" + results.format_tables(_rows(options.streams, groups, peers)) + "\n")
    print(f"wrote {options.output}")
    picture = options.output.with_suffix(".png")
    drawn = figure.save_figure(picture, groups, peers)
    print(f"wrote {picture}" if drawn else "no figure of the error over time: it needs matplotlib")

    if options.update_tables:
        results.update_tables(_TABLES, groups)
        print(f"wrote {_TABLES}")
    if options.ablation:
        print("not compared with the baseline: many configurations of one name")
        return 0
    if options.update_baseline:
        gate.update_baseline(options.baseline, runs)
        print(f"wrote {options.baseline}")
        return 0
    if overrides:
        print("changed configurations are compared with the unchanged ones")
    verdict = gate.compare(records.read(options.baseline), runs)
    for heading, lines in (
        ("not compared", verdict.skipped),
        ("better than the baseline (accept them with --update-baseline)", verdict.better),
        ("WORSE than the baseline", verdict.worse),
    ):
        if lines:
            print(f"\n{heading}:\n" + "\n".join(f"  {line}" for line in lines))
    print(f"{verdict.compared} figures compared with {options.baseline}")
    return 1 if verdict.worse else 0


def _measure(options: argparse.Namespace, table: Mapping[str, dict[str, Any]]) -> tuple[Any, Any]:
    """Returns the runs by (stream, label of the configuration), and the peers by stream."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    peers: dict[str, dict[str, results.Figures]] = {}
    overrides = dict(options.override)
    changed = [f"{field}={value}" for field, value in overrides.items()]
    for name in options.streams:
        source = open_source(options.data, name, options.frames)
        if source.complete:  # peers have mapped whole streams
            peers[name] = results.load_peers().get(name, {})
        for config_name, (row, changes) in product(options.configs, table.items()):
            label = ", ".join(filter(None, (config_name, *changed, row)))
            group = groups.setdefault((name, label), [])
            for seed in options.seeds:
                group.append(
                    measure_source(source, config_name, seed, options.every, overrides | changes)
                )
                # A long run that is cut off leaves its start.
                records.write(options.output, [run for runs in groups.values() for run in runs])
    return groups, peers


def _rows(
    streams: Sequence[str],
    groups: Mapping[tuple[str, str], list[dict[str, Any]]],
    peers: Mapping[str, Mapping[str, results.Figures]],
) -> dict[tuple[str, str, str], results.Figures]:
    """Returns the rows of the table, the peers of each stream below our own."""
    rows = {}
    for name in streams:
        for (stream, label), group in groups.items():
            if stream == name:
                for variant, figures in results.figures_of(group).items():
                    rows[stream, label, variant] = figures
        for peer, figures in peers.get(name, {}).items():
            rows[name, peer, ""] = figures
    return rows


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accuracy",
        description="Accuracy on streams, compared with a baseline; exit code 1 if it got worse.",
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument(
        "--streams",
        nargs="+",
        default=["house_depth", "house_lidar", "kitchen_depth", "hall_lidar"],
        metavar="NAME",
        help="NAME.npz in the folder, or demo (default: %(default)s)",
    )
    parser.add_argument(
        "--configs", nargs="+", default=["light"], choices=("light", "paper", "default")
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="SEED")
    parser.add_argument("--frames", type=_positive, metavar="N", help="only the first N frames")
    parser.add_argument(
        "--every",
        type=_positive,
        default=10,
        metavar="N",
        help="score after every N frames, for the figure (default: %(default)s)",
    )
    parser.add_argument(
        "--override",
        type=_override,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change a field of the configurations; repeatable",
    )
    parser.add_argument("--ablation", choices=ABLATIONS, help="run a table of changes")
    parser.add_argument("--baseline", type=Path, default=_BASELINE, metavar="FILE")
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
        default=Path("hiosdf_output/accuracy.json"),
        metavar="FILE",
        help="all runs; the picture is written beside it (default: %(default)s)",
    )
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}, expected at least 1")
    return value


def _override(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError as error:
        raise argparse.ArgumentTypeError(f"{text!r}, expected NAME=NUMBER") from error


if __name__ == "__main__":
    sys.exit(main())
