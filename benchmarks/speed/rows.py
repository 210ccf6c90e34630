"""Timing, and the rows of the table."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from hiosdf_jax.scoring import lay_out


@dataclasses.dataclass(frozen=True)
class Spread:
    """Of repeated measurements; p99 of fewer than a hundred is next to their maximum."""

    median: float
    p10: float
    p90: float
    p99: float
    count: int


@dataclasses.dataclass(frozen=True)
class Baseline:
    """The same work done otherwise: how long it took, or why it was not measured."""

    name: str
    spread: Spread | None
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement.

    Attributes:
        name: What was measured.
        unit: Of the spread.
        spread: What came out; None for a row that has no numbers, as the note says.
        compare: Key of the baselines that the row stands beside; "" if it has none.
        limit: What bounds it: "matrix", "vector" or "memory"; "" where no bound is stated.
        share: The time of that bound over the median.
        note: Whatever else is to be known.
        failed: It should have had numbers.
    """

    name: str
    unit: str = ""
    spread: Spread | None = None
    compare: str = ""
    limit: str = ""
    share: float = math.nan
    note: str = ""
    failed: bool = False


Baselines = Mapping[str, Sequence[Baseline]]


def spread_of(values: Iterable[float]) -> Spread:
    """Percentiles of measurements, of which there is at least one."""
    array = np.asarray(list(values), float)
    median, p10, p90, p99 = (float(x) for x in np.percentile(array, (50, 10, 90, 99)))
    return Spread(median, p10, p90, p99, len(array))


def single(value: float) -> Spread:
    """A value that was measured once."""
    return Spread(value, value, value, value, 1)


def time_ms(
    function: Callable[..., Any],
    *arguments: Any,
    seconds: float,
    block: Callable[[Any], Any] = jax.block_until_ready,
) -> Spread:
    """Times a function, warmed up, until `seconds` are over: 5 to 300 times.

    Args:
        function: Compiled, if it is to be.
        *arguments: Its arguments.
        seconds: How long to go on.
        block: Waits until a result is there.

    Returns:
        ms.
    """
    for _ in range(2):
        block(function(*arguments))
    times, end = [], time.perf_counter() + seconds
    while len(times) < 5 or (len(times) < 300 and time.perf_counter() < end):
        start = time.perf_counter()
        block(function(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return spread_of(times)


def format_table(rows: Sequence[Row], baselines: Baselines) -> str:
    """Lays rows out for a terminal, each with its baselines under one another.

    The last column is the row's median as a multiple of the baseline's.
    """
    cells = [["", "unit", "median", "p10", "p90", "p99", "limit", "share", "baseline", "", "of it"]]
    notes = []
    for row in rows:
        name = row.name
        if row.note:
            notes.append(row.note)
            name += f" [{len(notes)}]"
        spread = row.spread
        if spread is None:
            numbers = ["FAILED" if row.failed else "none", "", "", ""]
        elif spread.count == 1:
            numbers = [_number(spread.median), "", "", ""]
        else:
            numbers = [_number(x) for x in (spread.median, spread.p10, spread.p90, spread.p99)]
        share = "" if math.isnan(row.share) else f"{100 * row.share:.1f} %"
        start = [name, row.unit, *numbers, row.limit, share]
        beside = [_compare(spread, one) for one in baselines.get(row.compare, ())]
        if row.compare and not beside:
            beside = [(row.compare, "none", "")]
        cells.append([*start, *(beside[0] if beside else ("", "", ""))])
        cells += [[""] * len(start) + list(more) for more in beside[1:]]
    lines = [f"[{k}] {note}" for k, note in enumerate(notes, 1)]
    return "\n".join([_align(cells), *lines])


def _align(cells: list[list[str]]) -> str:
    """As `lay_out`, with text in the columns for it: names, units, limits and baselines."""
    text = [0, 1, 6, 8]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]

    def pad(cell: str, column: int) -> str:
        return (cell.ljust if column in text else cell.rjust)(widths[column])

    padded = [[pad(cell, column) for column, cell in enumerate(row)] for row in cells]
    return lay_out(padded, text_columns=len(widths))


def _compare(spread: Spread | None, baseline: Baseline) -> tuple[str, str, str]:
    """Name and median of a baseline, and the row's median as a multiple of it."""
    if baseline.spread is None:
        return f"{baseline.name}: {baseline.reason}", "none", ""
    multiple = "" if spread is None else _number(spread.median / baseline.spread.median)
    return baseline.name, _number(baseline.spread.median), multiple


def _number(value: float) -> str:
    """Three digits or more."""
    if not math.isfinite(value):
        return str(value)
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:,.{min(digits, 6)}f}"
