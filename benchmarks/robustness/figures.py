"""What each figure means, which values it must have, and how a table shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np

# {row: {figure: one value per seed}}
Results = dict[str, dict[str, list[float]]]


class Figure(NamedTuple):
    """How a figure is read.

    Attributes:
        unit: "cm", "share" or "ratio".
        better: "lower", "higher" or "nearer 0".
    """

    unit: str
    better: str


class Bar(NamedTuple):
    """What a figure must be.

    Attributes:
        rows: Pattern of the rows.
        figure: The figure.
        least: Its least value.
        most: Its largest value.
    """

    rows: str
    figure: str
    least: float
    most: float


FIGURES = {
    "solid": Figure("share", "higher"),
    "solid_lower": Figure("share", "higher"),
    "outward": Figure("share", "higher"),
    "pushed_out": Figure("share", "higher"),
    "old": Figure("share", "higher"),
    "old_lower": Figure("share", "higher"),
    "old_network": Figure("share", "higher"),
    "side_cm": Figure("cm", "lower"),
    "worst_side_cm": Figure("cm", "lower"),
    "side_network_cm": Figure("cm", "lower"),
    "side_lower": Figure("share", "higher"),
    "ghost": Figure("share", "lower"),
    "worst_ghost": Figure("share", "lower"),
    "row_recall": Figure("share", "higher"),
    "row_precision": Figure("share", "higher"),
    "arm_ghost": Figure("share", "lower"),
    "kept": Figure("share", "higher"),
    "error_cm": Figure("cm", "lower"),
    "error_ratio": Figure("ratio", "lower"),
    "bias_cm": Figure("cm", "nearer 0"),
    "flagged": Figure("share", "higher"),
    "flagged_first": Figure("share", "higher"),
    "false_alarms": Figure("share", "lower"),
    "through_walls": Figure("share", "lower"),
    "lower_excess": Figure("share", "lower"),
    "finite": Figure("share", "higher"),
    "coverage": Figure("share", "higher"),
    "slack_cm": Figure("cm", "lower"),
}

_ANY = np.inf
BARS = (
    Bar("appears*", "solid", 0.99, 1),
    Bar("appears*", "solid_lower", 0.99, 1),
    Bar("appears*", "pushed_out", 0.99, 1),
    Bar("appears*", "side_cm", 0, 2),
    Bar("jumps*", "old", 0.95, 1),
    Bar("jumps*", "old_lower", 0.95, 1),
    Bar("jumps*", "old_network", 0.95, 1),
    Bar("jumps*", "side_cm", 0, 2),
    Bar("jumps*", "side_network_cm", 0, 2),
    Bar("jumps*", "side_lower", 0.95, 1),
    Bar("crosses*", "side_cm", 0, 3),
    Bar("crosses*", "worst_side_cm", 0, 3),
    Bar("walks*", "side_cm", 0, 3),
    Bar("walks*", "worst_side_cm", 0, 3),
    Bar("walks*", "ghost", 0, 0.02),
    Bar("walks*", "worst_ghost", 0, 0.02),
    Bar("walks*", "error_ratio", 0, 1.05),
    Bar("walks*", "row_recall", 0.95, 1),
    Bar("walks*", "row_precision", 0.9, 1),
    Bar("arm*", "arm_ghost", 0, 0),
    Bar("arm*", "error_ratio", 0, 1.05),
    Bar("arm*", "kept", 0.95, 1),
    Bar("apartment: chair moved", "old", 0.95, 1),
    Bar("apartment: chair moved", "side_cm", 0, 2),
    Bar("apartment: door opens", "old", 0.95, 1),
    Bar("apartment: person walks", "side_cm", 0, 3),
    Bar("apartment: person walks", "worst_side_cm", 0, 3),
    Bar("apartment: person walks", "ghost", 0, 0.02),
    Bar("apartment: person walks", "worst_ghost", 0, 0.02),
    Bar("apartment: at the end", "error_ratio", 0, 1.05),
    Bar("apartment: person walks", "row_recall", 0.95, 1),
    Bar("apartment: person walks", "row_precision", 0.9, 1),
    Bar("apartment: arm in view", "arm_ghost", 0, 0),
    Bar("apartment: arm in view", "error_ratio", 0, 1.05),
    Bar("*: ?0 random clouds", "flagged", 0.9, 1),
    Bar("*: ?0 random clouds", "error_ratio", 0, 1.1),
    Bar("*: 10 clouds *", "flagged", 0.9, 1),
    Bar("*: 10 clouds *", "error_ratio", 0, 1.1),
    Bar("*: 5 frames 1 m off", "flagged", 0.9, 1),
    Bar("*: 5 frames 1 m off", "error_ratio", 0, 1.1),
    Bar("*: each frame 1 m off", "flagged", 0.9, 1),
    Bar("*: lens covered*", "flagged", 0.9, 1),
    Bar("*: lens covered*", "error_ratio", 0, 1.1),
    Bar("*: a pose 1e20 m away", "flagged", 0.9, 1),
    Bar("*: a pose 1e20 m away", "error_ratio", 0, 1.1),
    Bar("*: then all beyond max_range", "flagged", 0.9, 1),
    Bar("*: then all beyond max_range", "error_ratio", 0, 1.1),
    Bar("*: 5 % outliers", "error_ratio", 0, 1.3),
    Bar("*: 30 % drop-outs", "error_ratio", 0, 1.05),
    Bar("*: 5 cm noise*", "bias_cm", -1, 1),
    Bar("*: millimeters from the start", "flagged_first", 1, 1),
    Bar("*", "finite", 1, 1),
    Bar("*: clean", "false_alarms", 0, 0),
    Bar("*", "through_walls", 0, 0.001),
    Bar("*", "lower_excess", 0, 0.01),
    Bar("*", "coverage", 0.99, 1),
    Bar("*", "slack_cm", -_ANY, 6),
)


class Check(NamedTuple):
    """Whether one row meets one bar.

    Attributes:
        row: The row.
        bar: The bar.
        value: Mean over the seeds; NaN if the figure was not measured.
        met: Whether it does.
    """

    row: str
    bar: Bar
    value: float
    met: bool


def check(results: Results) -> list[Check]:
    """Compares results with the bars.

    Args:
        results: The results.

    Returns:
        One check per row and bar. A row without the figure fails, except for bars of all rows.
    """
    checks = []
    for row, figures in results.items():
        for bar in BARS:
            if not fnmatchcase(row, bar.rows) or (bar.rows == "*" and bar.figure not in figures):
                continue
            value = float(np.mean(figures.get(bar.figure, [np.nan])))
            checks.append(Check(row, bar, value, bar.least <= value <= bar.most))
    return checks


def format_tables(groups: Mapping[str, Results]) -> str:
    """Lays results out for a terminal.

    Args:
        groups: {scenario: its results}, a table for each.

    Returns:
        The tables; a figure that misses its bar has an exclamation mark.
    """
    return "\n\n".join(_format(results) for results in groups.values())


def _format(results: Results) -> str:
    missed = {(each.row, each.bar.figure) for each in check(results) if not each.met}
    names = [
        name
        for name in FIGURES
        if any(name in figures for figures in results.values())
        or any(name == figure for _, figure in missed)
    ]
    cells = [["", *names]]
    for row, figures in results.items():
        shown = [
            _show(figures.get(name)) + ("!" if (row, name) in missed else " ") for name in names
        ]
        cells.append([row, *shown])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(
            [line[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        )
        for line in cells
    )


def _show(values: Sequence[float] | None) -> str:
    return "-" if values is None else f"{np.mean(values):.3g}"
