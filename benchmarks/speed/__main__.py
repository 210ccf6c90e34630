"""The command that runs all tasks and writes one table and one record."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from tqdm import tqdm

from benchmarks import records
from benchmarks.speed.plan import Task, make_plan
from benchmarks.speed.rows import (
    OUT_OF_TIME,
    Baseline,
    Baselines,
    Measured,
    Row,
    format_table,
    to_record,
)
from benchmarks.speed.setup import FULL, QUICK, Setup, open_setup
from hiosdf_jax._src.command.timing import host_name


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: Those after the command's name; those of the process if left out.

    Returns:
        The exit code, 1 if a row failed.
    """
    began = time.perf_counter()
    parser = _parser()
    options = parser.parse_args(arguments)
    if not options.stream.is_file():
        parser.error(f"{options.stream}: no such file")
    sizes = QUICK if options.quick else FULL
    if options.endurance is not None:
        sizes = dataclasses.replace(sizes, endurance=options.endurance)
    setup = open_setup(options.stream, sizes, began + 60 * options.minutes)
    tasks = make_plan(setup)
    if options.only:
        chosen = [name for name in tasks if any(part in name for part in options.only)]
        if not chosen:
            names = ", ".join(map(repr, tasks))
            parser.error(f"--only {' '.join(options.only)}: in the name of no task: {names}")
        tasks = {name: tasks[name] for name in chosen}
    rows: list[Row] = []
    baselines: dict[str, Sequence[Baseline]] = {}
    with tqdm(tasks.items(), unit="task") as progress:
        for name, task in progress:
            progress.set_description(name)
            measured = _run(setup, name, task)
            rows += measured.rows
            baselines |= measured.baselines
            took_s = time.perf_counter() - began
            record = _record(setup, rows, baselines, took_s)
            records.write(options.output, record)  # a run that is cut off leaves its start
    device = jax.devices()[0].device_kind
    print(
        f"{options.stream.stem}, {device}, {host_name()}, jax {jax.__version__}, "
        f"{took_s:.0f} s in all"
    )
    print(format_table(rows, baselines))
    print(f"wrote {options.output}")
    return 1 if any(row.failed for row in rows) else 0


def _run(setup: Setup, name: str, task: Task) -> Measured:
    """Runs a task; one that fails gives a row with the reason."""
    if setup.is_over():
        return Measured([Row(name, note=OUT_OF_TIME)])
    try:
        return task()
    except Exception as error:
        traceback.print_exc()
        # The first lines: an accelerator that is out of memory lists all its buffers.
        reason = " ".join(str(error).split())[:200]
        return Measured([Row(name, note=f"{type(error).__name__}: {reason}", failed=True)])


def _record(setup: Setup, rows: Sequence[Row], baselines: Baselines, took_s: float) -> Any:
    head = {"stream": setup.path.stem, "host": host_name(), "took_s": records.rounded(took_s)}
    beside = {key: [to_record(one) for one in found] for key, found in baselines.items()}
    return (
        head
        | records.provenance()
        | {
            "sizes": dataclasses.asdict(setup.sizes),
            "rows": [to_record(row) for row in rows],
            "baselines": beside,
        }
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description="Time and memory of a map, beside baselines measured in the same run.",
    )
    parser.add_argument(
        "--stream", type=Path, default=Path("../shared/data/house_depth.npz"), metavar="FILE"
    )
    parser.add_argument(
        "--quick", action="store_true", help="smaller sizes and light alone, for two CPU cores"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PART",
        help="run only the tasks with one of these in their names",
    )
    parser.add_argument(
        "--endurance",
        type=int,
        metavar="N",
        help=f"updates in a row (default: {FULL.endurance:,}; quick: {QUICK.endurance})",
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=8.0,
        help="time limit, after which the remaining tasks are not run (default: %(default)s)",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("hiosdf_output/speed.json"),
        metavar="FILE",
        help="default: %(default)s",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
