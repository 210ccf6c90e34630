"""Timing, and the rows of the table and the record."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

from benchmarks import records
from hiosdf_jax._src.command.timing import format_number, time_calls
from hiosdf_jax.scoring import lay_out


@dataclasses.dataclass(frozen=True)
class Spread:
    """Percentiles of repeated measurements; p99 of fewer than a hundred is near their maximum."""

    median: float
    p10: float
    p90: float
    p99: float
    count: int


@dataclasses.dataclass(frozen=True)
class Baseline:
    """The same work done another way: how long it took, or why it was not measured."""

    name: str
    spread: Spread | None
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Row:
    """A measurement.

    Attributes:
        name: What was measured.
        unit: Unit of the spread.
        spread: The result; None for a row without numbers, for the reason in the note.
        compare: Key of the baselines beside the row; "" if it has none.
        limit: Its narrowest limit, "matrix", "vector" or "memory"; "" where none is stated.
        share: The time at that limit, divided by the median.
        note: A remark.
        failed: Whether numbers are missing because of an error.
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


class Measured(NamedTuple):
    """The result of a task.

    Attributes:
        rows: The rows, which may name baselines of other tasks.
        baselines: Baselines by the key that rows name.
    """

    rows: list[Row]
    baselines: Baselines = MappingProxyType({})


OUT_OF_TIME = "not run: --minutes are over"


def spread_of(values: Iterable[float]) -> Spread:
    """Computes the percentiles of at least one measurement."""
    measured = list(values)
    return Spread(**records.percentiles(measured, (50, 10, 90, 99)), count=len(measured))


def single(value: float) -> Spread:
    """Wraps a value that was measured once."""
    return Spread(value, value, value, value, 1)


def to_record(measured: Row | Baseline) -> dict[str, Any]:
    """Flattens a row or a baseline for its record, without what it does not have."""
    fields = dataclasses.asdict(measured)
    spread = fields.pop("spread") or {}
    if spread.get("count") == 1:
        spread = {"median": spread["median"]}
    first = {key: fields.pop(key) for key in ("name", "unit") if key in fields}
    return {
        key: records.rounded(value) if isinstance(value, float) else value
        for key, value in (first | spread | fields).items()
        if value is not False and value != "" and value == value  # NaN differs from itself
    }


def time_ms(
    function: Callable[..., Any],
    *arguments: Any,
    seconds: float,
    block: Callable[[Any], Any] = jax.block_until_ready,
) -> Spread:
    """Times a function after two calls that warm up.

    Args:
        function: The function.
        *arguments: Its arguments.
        seconds: How long to repeat it; it is called 5 to 300 times.
        block: Waits until a result is there.

    Returns:
        The times, ms.
    """
    return spread_of(time_calls(function, *arguments, seconds=seconds, block=block))


def format_table(rows: Sequence[Row], baselines: Baselines) -> str:
    """Lays rows out for a terminal, each with its baselines below one another.

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
            numbers = [format_number(spread.median), "", "", ""]
        else:
            numbers = [
                format_number(x) for x in (spread.median, spread.p10, spread.p90, spread.p99)
            ]
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
    """Lays cells out with names, units, limits and baselines as text, aligned to the left."""
    text = [0, 1, 6, 8]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]

    def pad(cell: str, column: int) -> str:
        return (cell.ljust if column in text else cell.rjust)(widths[column])

    padded = [[pad(cell, column) for column, cell in enumerate(row)] for row in cells]
    return lay_out(padded, text_columns=len(widths))


def _compare(spread: Spread | None, baseline: Baseline) -> tuple[str, str, str]:
    """Returns name and median of a baseline, and the row's median as a multiple of it."""
    if baseline.spread is None:
        return f"{baseline.name}: {baseline.reason}", "none", ""
    multiple = "" if spread is None else format_number(spread.median / baseline.spread.median)
    return baseline.name, format_number(baseline.spread.median), multiple
