"""The command: all tasks, one table, one JSON file."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

import jax
from tqdm import tqdm

from benchmarks.speed.rows import Row, format_table
from benchmarks.speed.tasks import FULL, OUT_OF_TIME, QUICK, Bench, Task, open_bench, plan
from hiosdf_jax._src.command.report import to_json


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the benchmark.

    Args:
        arguments: Those after the command's name; by default those of the process.

    Returns:
        The exit code: 1 if a row failed.
    """
    began = time.perf_counter()
    parser = _parser()
    options = parser.parse_args(arguments)
    if not options.stream.is_file():
        parser.error(f"{options.stream}: no such file")
    sizes = QUICK if options.quick else FULL
    if options.endurance is not None:
        sizes = dataclasses.replace(sizes, endurance=options.endurance)
    bench = open_bench(options.stream, sizes, began + 60 * options.minutes)
    tasks = list(plan(bench))
    if options.only:
        chosen = [task for task in tasks if any(part in task[0] for part in options.only)]
        if not chosen:
            names = ", ".join(repr(name) for name, _ in tasks)
            parser.error(f"--only {' '.join(options.only)}: in the name of no task: {names}")
        tasks = chosen
    rows: list[Row] = []
    with tqdm(tasks, unit="task") as progress:
        for name, task in progress:
            progress.set_description(name)
            rows += _run(bench, name, task)
            took_s = time.perf_counter() - began
            _write(options.output, options.stream.stem, bench, rows, took_s)  # if it is cut off
    device = jax.devices()[0].device_kind
    print(
        f"{options.stream.stem}, {device}, {_host()}, jax {jax.__version__}, {took_s:.0f} s in all"
    )
    print(format_table(rows, bench.baselines))
    print(f"wrote {options.output}")
    return 1 if any(row.failed for row in rows) else 0


def _run(bench: Bench, name: str, task: Task) -> list[Row]:
    """Runs a task; one that fails gives a row that says why."""
    if bench.out_of_time():
        return [Row(name, note=OUT_OF_TIME)]
    try:
        return task()
    except Exception as error:
        traceback.print_exc()
        # The first lines: what an accelerator runs out of comes with a long list of buffers.
        reason = " ".join(str(error).split())[:200]
        return [Row(name, note=f"{type(error).__name__}: {reason}", failed=True)]


def _write(path: Path, stream: str, bench: Bench, rows: list[Row], took_s: float) -> None:
    record = {
        "stream": stream,
        "device": jax.devices()[0].device_kind,
        "host": _host(),
        "jax": jax.__version__,
        "took_s": took_s,
        "sizes": dataclasses.asdict(bench.sizes),
        "rows": [dataclasses.asdict(row) for row in rows],
        "baselines": {
            key: [dataclasses.asdict(one) for one in found]
            for key, found in bench.baselines.items()
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(to_json(record), indent=1) + "\n", "utf-8")


def _host() -> str:
    """The host's processor and its cores."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text("utf-8").splitlines() if known.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{[*models, platform.processor()][0]}, {os.cpu_count()} cores"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description="Time and memory of a map, beside baselines measured in the same run.",
    )
    parser.add_argument(
        "--stream", type=Path, default=Path("../shared/data/house_depth.npz"), metavar="FILE"
    )
    parser.add_argument(
        "--quick", action="store_true", help="smaller sizes, for two CPU cores: light alone"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PART",
        help="tasks with one of these in their names (stages and queries need an update's task)",
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
        help="then the updates in a row stop, and what is left is not run (default: %(default)s)",
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
