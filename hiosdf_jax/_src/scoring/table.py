"""Scores as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hiosdf_jax._src.scoring.metrics import METRICS


def format_table(scores: Mapping[str, float]) -> str:
    """Formats scores as a table.

    Args:
        scores: From `evaluate` or `held_out_surface`.

    Returns:
        The table. Each row has a metric, its unit, which direction is better, and the score; a dash
        stands for "no value".

    Example:
        scores = scoring.evaluate(lambda points: hio.sdf_and_grad(field, points), truth)
        print(scoring.format_table(scores))
    """
    cells = [["metric", "unit", "better", "ours"]]
    cells += [[*METRICS[key], format_score(key, scores[key])] for key in METRICS if key in scores]
    return lay_out(cells, text_columns=3)


def format_reasons(reasons: Mapping[str, str]) -> str:
    """Formats why scores have no value.

    Args:
        reasons: From `explain_missing`.

    Returns:
        A line for each of them.
    """
    return "\n".join(f"{METRICS[key].label}: {reason}" for key, reason in reasons.items())


def format_bands(bands: Mapping[str, Mapping[str, float]]) -> str:
    """Formats scores by band of the true distance as a table.

    Args:
        bands: From `evaluate_bands`.

    Returns:
        The table, one row per band, one column per metric.

    Example:
        bands = scoring.evaluate_bands(lambda points: hio.sdf_and_grad(field, points), truth)
        print(scoring.format_bands(bands))
    """
    keys = [key for key in METRICS if any(key in scores for scores in bands.values())]
    cells = [["true distance", *keys]]
    for band, scores in bands.items():
        cells.append([band, *(format_score(key, scores.get(key)) for key in keys)])
    return lay_out(cells, text_columns=1)


def format_score(key: str, value: Any) -> str:
    """Formats a score as in all tables.

    Args:
        key: One of `METRICS`.
        value: The score, a sequence of scores to average, or None.

    Returns:
        Two decimals for centimeters, none for parts per million, three for anything else; a dash
        for no value or NaN.

    Example:
        print(scoring.format_score("visible_cm", 0.4213))  # 0.42
    """
    if value is None or not np.isfinite(np.mean(value)):
        return "-"
    decimals = {"cm": 2, "ppm": 0}.get(METRICS[key].unit, 3)
    return f"{np.mean(value):.{decimals}f}"


def lay_out(cells: Sequence[Sequence[str]], text_columns: int) -> str:
    """Aligns the columns of a table and underlines its first row.

    Args:
        cells: Rows of equal length, the first of them the headings.
        text_columns: Number of leading columns with text, aligned left; the others are numbers,
            aligned right.

    Returns:
        The table, without a trailing line break.

    Example:
        print(scoring.lay_out([["map", "cm"], ["ours", "0.42"]], text_columns=1))
    """
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = [
        "  ".join(
            cell.ljust(width) if i < text_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])
