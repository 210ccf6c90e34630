"""The figures of all runs: gathered over seeds, laid out as a table, and written to a record."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import records
from hiosdf_jax.scoring import METRICS, format_score, lay_out

_PEERS = Path(__file__).with_name("peers.json")

# What the tables of the documents show.
_TABLE_METRICS = (
    *("visible_cm", "recall", "fpr", "thin_share", "median_cm", "p90_cm", "cosine", "eikonal"),
    *("mesh_accuracy_cm", "mesh_completeness_cm", "mesh_f_1cm", "mesh_f_2cm", "mesh_f_5cm"),
    *("mesh_sdf_cm", "mesh_thin_share", "mesh_median_cm", "mesh_p90_cm"),
    *("steps_ppm", "step_largest_cm", "far_flips_ppm"),
)

Figures = dict[str, list[float]]  # {metric, or "metric band": one value per seed}


def figures_of(runs: Sequence[dict[str, Any]]) -> dict[str, Figures]:
    """Gathers the figures of runs that differ in their seeds alone.

    Args:
        runs: From `measure_source`.

    Returns:
        {variant: figures}, for all figures that were measured.
    """
    gathered: dict[str, Figures] = {}
    for run in runs:
        for variant, measured in run["variants"].items():
            figures = gathered.setdefault(variant, {})
            flat = dict(measured["scores"])
            for band, scores in measured["bands"].items():
                flat |= {f"{metric} {band}": value for metric, value in scores.items()}
            for name, value in flat.items():
                figures.setdefault(name, []).append(np.nan if value is None else value)
    return gathered


def meaning(figure: str) -> str:
    """Returns the metric of a figure.

    Args:
        figure: A metric, or a metric and a band.

    Returns:
        A key of `METRICS`.
    """
    return figure.split(" ", 1)[0]


def describe(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns what identifies runs that differ in their seeds alone.

    Args:
        runs: From `measure_source`.

    Returns:
        Their number of frames, device, version of jax, revision and seeds.
    """
    shared = {key: runs[0][key] for key in ("frames", "device", "jax", "revision")}
    return shared | {"seeds": [run["seed"] for run in runs]}


def update_tables(path: Path, groups: Mapping[tuple[str, str], Sequence[dict[str, Any]]]) -> None:
    """Writes the figures that the documents show into their record; other entries stay.

    Args:
        path: The record; made if it is not there.
        groups: {(stream, label of the configuration): runs from `measure_source`}.
    """
    record = records.read(path)
    for (stream, label), runs in groups.items():
        figures = figures_of(runs)
        record.setdefault(stream, {})[label] = describe(runs) | {
            "mean": _for_tables(figures, np.mean),
            "half_range": _for_tables(figures, lambda values: np.ptp(values) / 2),
        }
    records.write(path, record)


def load_peers() -> dict[str, dict[str, Figures]]:
    """Reads what other systems score.

    Returns:
        {stream: {peer: figures}}.
    """
    peers = json.loads(_PEERS.read_text("utf-8"))
    return {
        stream: {
            name: {metric: np.atleast_1d(value).tolist() for metric, value in scores.items()}
            for name, scores in systems.items()
        }
        for stream, systems in peers.items()
    }


def format_tables(rows: Mapping[tuple[str, str, str], Figures]) -> str:
    """Lays figures out for a terminal: the scores, and below them those by band of true distance.

    Args:
        rows: {(stream, configuration or peer, variant): figures}.

    Returns:
        The table. Several seeds are given as their mean and half of their range.
    """
    names = [key for key in METRICS if any(key in figures for figures in rows.values())]
    cells = [["stream", "map", "variant", *names]]
    for labels, figures in rows.items():
        cells.append([*labels, *(_cell(name, figures.get(name)) for name in names)])
    tables = [lay_out(cells, text_columns=3)]
    banded = dict.fromkeys(name for figures in rows.values() for name in figures if " " in name)
    bands = list(dict.fromkeys(name.split(" ", 1)[1] for name in banded))
    if bands:
        cells = [["stream", "map", "variant", "by true distance", *bands]]
        for labels, figures in rows.items():
            for metric in dict.fromkeys(meaning(name) for name in figures if name in banded):
                values = (figures.get(f"{metric} {band}") for band in bands)
                cells.append([*labels, metric, *(_cell(metric, value) for value in values)])
        tables.append(lay_out(cells, text_columns=4))
    return "\n\n".join(tables)


def _for_tables(
    figures: Mapping[str, Figures], statistic: Callable[[list[float]], Any]
) -> dict[str, dict[str, float]]:
    """Returns {variant: {metric: a statistic over the seeds}}."""
    return {
        variant: {
            metric: records.rounded(float(statistic(values[metric])))
            for metric in _TABLE_METRICS
            if metric in values
        }
        for variant, values in figures.items()
    }


def _cell(name: str, values: list[float] | None) -> str:
    text = format_score(meaning(name), values)
    if text == "-" or values is None or len(values) < 2:
        return text
    return f"{text}±{format_score(meaning(name), np.ptp(values) / 2)}"
