"""Which figures are worse than in a committed baseline.

A figure is worse if its mean over the seeds has moved the wrong way by more than the largest of:
three standard errors of the difference, from the spread between the seeds on both sides; 5 % of the
baseline; 0.02 cm, or 0.002 of what has no unit.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.accuracy.results import figures_of, meaning
from hiosdf_jax.scoring import METRICS, format_score

_ERRORS = 3.0
_SHARE = 0.05
_FLOORS = {"cm": 0.02, "-": 0.002}

# {stream: {configuration: {"frames", "device", "jax", "seeds", "figures": {variant: figures}}}}
Baseline = dict[str, dict[str, dict[str, Any]]]


class Verdict(NamedTuple):
    """What a comparison found; lines for a terminal.

    Attributes:
        worse: Figures that got worse, or cannot be told any more.
        better: Figures that got better by as much.
        skipped: What was not compared, and why.
        compared: How many figures were.
    """

    worse: list[str]
    better: list[str]
    skipped: list[str]
    compared: int


def load_baseline(path: Path) -> Baseline:
    """Reads a baseline.

    Args:
        path: The file.

    Returns:
        The baseline; an empty one if there is no such file.
    """
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def update_baseline(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """Writes the figures of runs into a baseline; those of other runs in it stay.

    Args:
        path: The file; made if it is not there.
        records: From `measure`, without overrides.
    """
    baseline = load_baseline(path)
    for (stream, config_name), group in by_map(records).items():
        baseline.setdefault(stream, {})[config_name] = {
            "frames": group[0]["frames"],
            "device": group[0]["device"],
            "jax": group[0]["jax"],
            "seeds": [record["seed"] for record in group],
            "figures": {
                variant: {name: values for name, values in figures.items() if _is_number(values)}
                for variant, figures in figures_of(group).items()
            },
        }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(baseline, indent=1, sort_keys=True) + "\n", "utf-8")


def compare(baseline: Baseline, records: Sequence[dict[str, Any]]) -> Verdict:
    """Compares runs with a baseline.

    Args:
        baseline: From `load_baseline`.
        records: From `measure`, of one configuration for each name.

    Returns:
        The verdict.
    """
    verdict = Verdict([], [], [], 0)
    for (stream, config_name), group in by_map(records).items():
        name = f"{stream} {config_name}"
        entry = baseline.get(stream, {}).get(config_name)
        if entry is None:
            verdict.skipped.append(f"{name}: not in the baseline")
            continue
        if entry["frames"] != group[0]["frames"]:
            frames = f"{group[0]['frames']} frames, the baseline has {entry['frames']}"
            verdict.skipped.append(f"{name}: {frames}")
            continue
        measured = figures_of(group)
        for variant, figures in entry["figures"].items():
            for figure, old in figures.items():
                place = f"{name} {variant}: {figure}"
                new = measured.get(variant, {}).get(figure)
                if new is None:
                    verdict.skipped.append(f"{place}: not measured")
                    continue
                verdict = verdict._replace(compared=verdict.compared + 1)
                change = _worsening(figure, old, new)
                if abs(change) <= tolerance(figure, old, new):  # False for NaN
                    continue
                told = f"{place} {_show(figure, old)} -> {_show(figure, new)}"
                told += f" (tolerance {_show(figure, [tolerance(figure, old, new)])})"
                (verdict.better if change < 0 else verdict.worse).append(told)
    return verdict


def tolerance(figure: str, old: Sequence[float], new: Sequence[float]) -> float:
    """How far a figure may move without a word; see the top of this module.

    Args:
        figure: A metric, or a metric and a band.
        old: One value a seed.
        new: One value a seed.

    Returns:
        The tolerance, in the figure's unit.
    """
    squares = [np.var(side) * len(side) for side in (old, new)]
    freedom = len(old) + len(new) - 2
    spread = np.sqrt(sum(squares) / freedom) if freedom else 0.0
    error = spread * np.sqrt(1 / len(old) + 1 / len(new))
    floor = _FLOORS[METRICS[meaning(figure)].unit]
    return float(np.nanmax([_ERRORS * error, _SHARE * abs(np.mean(old)), floor]))


def by_map(records: Sequence[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Groups runs that differ in their seeds alone.

    Args:
        records: From `measure`, of one configuration for each name.

    Returns:
        {(stream, configuration): records}.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["stream"], record["config_name"]), []).append(record)
    return groups


def _worsening(figure: str, old: Sequence[float], new: Sequence[float]) -> float:
    before, now = float(np.mean(old)), float(np.mean(new))
    better = METRICS[meaning(figure)].better
    if better == "higher":
        return before - now
    return abs(now) - abs(before) if better == "nearer 0" else now - before


def _show(figure: str, values: Sequence[float]) -> str:
    return format_score(meaning(figure), values)


def _is_number(values: Sequence[float]) -> bool:
    return bool(np.isfinite(values).all())
