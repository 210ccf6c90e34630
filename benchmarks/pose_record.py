"""The committed record of refined poses, tracked streams, found places and merged maps.

The record has {part: {stream: {row: {figure: value, "device", "jax", "revision"}}}}. The gate calls
a figure worse if it has moved the wrong way by more than `_MOST` or `_LEAST` allow. Figures vary
with the processor and the code, since rounding decides which of two near minima is found.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import records

RECORD = records.RESULTS / "registration.json"

Rows = Mapping[str, Mapping[str, Any]]  # {row: {figure: value}}

# What a figure may be, as a factor of the record's and an addend. Other figures are not compared.
_MOST = {
    "median_cm": (1.15, 0.03),
    "p95_cm": (1.15, 0.05),
    "median_deg": (1.15, 0.01),
    "p95_deg": (1.15, 0.02),
    "normalized_square": (1.2, 0.5),
    "far": (1.0, 1),
    "far_converged": (1.0, 1),
    "not_registered": (1.0, 2),
    "rms_cm": (1.3, 0.1),
    "end_cm": (1.5, 0.3),
    "map_cm": (1.2, 0.03),
    "fused_wrong": (1.0, 0),
    "refused": (1.0, 1),
    "taken": (1.1, 2),
    "wrong": (1.0, 1),
    "wrong_converged": (1.0, 1),
    "wrong_sure": (1.0, 0),
    "visible_cm": (1.1, 0.02),
    "fpr": (1.2, 0.001),
}
_LEAST = {"converged": (1.0, -1), "sure": (0.9, -2), "recall": (1.0, -0.005)}

# Errors of these rows vary by half between runs: only the wrong frames that they fuse are compared.
_VARYING = ("jitter", "glitch", "glitch left out")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds `--output` and `--gate` to a command.

    Args:
        parser: That of the command.
    """
    parser.add_argument("--output", type=Path, help="record to write the figures into")
    parser.add_argument(
        "--gate",
        action="store_true",
        help="exit with 1 if a figure is worse than the committed one",
    )


def finish(options: argparse.Namespace, part: str, stream: str, rows: Rows) -> int:
    """Writes rows into a record, and compares them with the committed one, as the options say.

    Args:
        options: Those of `add_options`.
        part: The part of the record, such as "refining".
        stream: The stream's name, with what else was chosen.
        rows: The measured figures.

    Returns:
        How many figures are worse, or 1 if the record has none of the rows; 0 without `--gate`.
    """
    committed = records.read(RECORD).get(part, {}).get(stream, {})
    if options.output and rows:
        keep(options.output, part, stream, rows)
    if not (options.gate and rows):
        return 0
    worse, compared = compare(committed, rows)
    for line in worse:
        print(f"WORSE {part}, {stream}, {line}")
    print(f"gate of {part}, {stream}: {compared} figures compared, {len(worse)} worse", flush=True)
    return len(worse) if rows.keys() & committed.keys() else 1


def keep(path: Path, part: str, stream: str, rows: Rows) -> None:
    """Writes rows into a record; its other rows stay.

    Args:
        path: The record; made if it is not there.
        part: The part of the record.
        stream: The stream's name.
        rows: The measured figures.
    """
    record: dict[str, Any] = records.read(path)
    kept = record.setdefault(part, {}).setdefault(stream, {})
    for row, figures in rows.items():
        rounded = {figure: records.rounded(float(value), 4) for figure, value in figures.items()}
        kept[row] = rounded | records.provenance()
    records.write(path, record)


def compare(committed: Rows, rows: Rows) -> tuple[list[str], int]:
    """Compares rows with those of a record.

    Args:
        committed: The record's.
        rows: The measured figures.

    Returns:
        A line for each figure that is worse or no number, and how many figures were compared.
    """
    limits = _MOST | _LEAST
    worse, compared = [], 0
    for row in rows.keys() & committed.keys():
        old, new = committed[row], rows[row]
        varies = row.split(", seed")[0] in _VARYING
        for figure in ("fused_wrong",) if varies else limits:
            if figure not in old or figure not in new:
                continue
            compared += 1
            factor, addend = limits[figure]
            limit = factor * old[figure] + addend
            holds = new[figure] >= limit if figure in _LEAST else new[figure] <= limit
            if not holds:  # also for NaN
                worse.append(f"{row}: {figure} {old[figure]:g} -> {new[figure]:g}")
    return sorted(worse), compared
