"""The command: streams x configurations x seeds, measured, compared and drawn."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.accuracy import figure, gate, results
from benchmarks.accuracy.measure import measure, open_source
from hiosdf_jax import Config
from hiosdf_jax._src.command.report import to_json

_BASELINE = Path(__file__).parents[1] / "results" / "accuracy_baseline.json"

# {table: {row: fields of the configuration that it changes}}
ABLATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "stages": {
        "as it is": {},
        "no carving": {"min_hit_ratio": 0.0},
        "one local ray": {"local_points": 1},
        "no Eikonal loss": {"eikonal_weight": 0.0},
        "last weights": {"weight_average": 0.0},
        "serves the network": {"grid_share": 0.0},
        "serves the grid": {"grid_share": 1.0},
    },
    "voxel_size": {f"{edge} m": {"voxel_size": edge} for edge in (0.05, 0.1, 0.2)},
    "grid_share": {f"{share}": {"grid_share": share} for share in (0.0, 0.5, 0.8, 0.9, 1.0)},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: Those after the command's name; by default those of the process.

    Returns:
        The exit code: 1 if a figure is worse than in the baseline.
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

    records, groups, peers = [], {}, {}
    for name in options.streams:
        source = open_source(options.data, name, options.frames)
        if source.complete:  # peers have mapped whole streams
            peers[name] = results.load_peers().get(name, {})
        for config_name in options.configs:
            for row, changes in table.items():
                label = ", ".join(filter(None, (config_name, row)))
                for seed in options.seeds:
                    changed = overrides | changes
                    record = measure(source, config_name, seed, options.every, changed)
                    records.append(record)
                    groups.setdefault((name, label), []).append(record)
                    _write(options.output, records)  # a long run that is cut off leaves its start
    rows = {}
    for name in options.streams:
        for (stream, label), group in groups.items():
            if stream == name:
                for variant, figures in results.figures_of(group).items():
                    rows[stream, label, variant] = figures
        for peer, figures in peers.get(name, {}).items():
            rows[name, peer, ""] = figures
    print("\n" + results.format_tables(rows) + "\n")
    print(f"wrote {options.output}")
    picture = options.output.with_suffix(".png")
    drawn = figure.save_figure(picture, groups, peers)
    print(f"wrote {picture}" if drawn else "no figure of the error over time: it needs matplotlib")

    if options.ablation:
        print("not compared with the baseline: many configurations of one name")
        return 0
    if options.update_baseline:
        gate.update_baseline(options.baseline, records)
        print(f"wrote {options.baseline}")
        return 0
    if overrides:
        print("what was changed is compared with the configuration as it is")
    verdict = gate.compare(gate.load_baseline(options.baseline), records)
    for heading, lines in (
        ("not compared", verdict.skipped),
        ("better than the baseline (--update-baseline takes it over)", verdict.better),
        ("WORSE than the baseline", verdict.worse),
    ):
        if lines:
            print(f"\n{heading}:\n" + "\n".join(f"  {line}" for line in lines))
    print(f"{verdict.compared} figures compared with {options.baseline}")
    return 1 if verdict.worse else 0


def _write(path: Path, records: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(to_json(records), indent=1) + "\n", "utf-8")


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
        help="score after each N frames, for the figure (default: %(default)s)",
    )
    parser.add_argument(
        "--override",
        type=_override,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="change a field of the configurations; may be given several times",
    )
    parser.add_argument("--ablation", choices=ABLATIONS, help="run a table of such changes")
    parser.add_argument("--baseline", type=Path, default=_BASELINE, metavar="FILE")
    parser.add_argument(
        "--update-baseline", action="store_true", help="write the figures into the baseline"
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("hiosdf_output/accuracy.json"),
        metavar="FILE",
        help="all figures; the picture is beside it (default: %(default)s)",
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
