"""Which figures are worse than in a committed baseline.

A figure is worse if its mean over the seeds has moved the wrong way by more than the largest of:
three standard errors of the difference, from the spread between the seeds on both sides; 5 % of the
baseline; 0.02 cm, 20 ppm, or 0.002 for a figure without a unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import records
from benchmarks.accuracy.results import describe, figures_of, meaning
from hiosdf_jax.scoring import METRICS, format_score

_ERRORS = 3.0
_SHARE = 0.05
_FLOORS = {"cm": 0.02, "ppm": 20.0, "-": 0.002}

# {stream: {configuration: what `describe` gives and "figures": {variant: figures}}}
Baseline = dict[str, dict[str, dict[str, Any]]]


class Verdict(NamedTuple):
    """The result of a comparison, as lines for a terminal.

    Attributes:
        worse: Figures that got worse, or that became NaN.
        better: Figures that got better by more than the tolerance.
        skipped: What was not compared, and why.
        compared: Number of figures that were compared.
    """

    worse: list[str]
    better: list[str]
    skipped: list[str]
    compared: int


def update_baseline(path: Path, runs: Sequence[dict[str, Any]]) -> None:
    """Writes the figures of runs into a baseline; its other entries stay.

    Args:
        path: The file; made if it is not there.
        runs: From `measure`, without overrides.
    """
    baseline = records.read(path)
    for (stream, config_name), group in by_map(runs).items():
        figures = {
            variant: {name: values for name, values in sorted(figures.items()) if _finite(values)}
            for variant, figures in figures_of(group).items()
        }
        baseline.setdefault(stream, {})[config_name] = describe(group) | {"figures": figures}
    records.write(path, baseline)


def compare(baseline: Baseline, runs: Sequence[dict[str, Any]]) -> Verdict:
    """Compares runs with a baseline.

    Args:
        baseline: What `update_baseline` wrote.
        runs: From `measure`, with one configuration for each name.

    Returns:
        The verdict.
    """
    verdict = Verdict([], [], [], 0)
    for (stream, config_name), group in by_map(runs).items():
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
                allowed = tolerance(figure, old, new)
                if abs(change) <= allowed:  # False for NaN
                    continue
                line = f"{place} {_show(figure, old)} -> {_show(figure, new)}"
                line += f" (tolerance {_show(figure, [allowed])})"
                (verdict.better if change < 0 else verdict.worse).append(line)
    return verdict


def tolerance(figure: str, old: Sequence[float], new: Sequence[float]) -> float:
    """Returns how far a figure may move; the top of this module has the rule.

    Args:
        figure: A metric, or a metric and a band.
        old: One value per seed.
        new: One value per seed.

    Returns:
        The tolerance, in the figure's unit.
    """
    squares = [np.var(side) * len(side) for side in (old, new)]
    freedom = len(old) + len(new) - 2
    spread = np.sqrt(sum(squares) / freedom) if freedom else 0.0
    error = spread * np.sqrt(1 / len(old) + 1 / len(new))
    floor = _FLOORS[METRICS[meaning(figure)].unit]
    return float(np.nanmax([_ERRORS * error, _SHARE * abs(np.mean(old)), floor]))


def by_map(runs: Sequence[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Groups runs that differ in their seeds alone.

    Args:
        runs: From `measure`, with one configuration for each name.

    Returns:
        {(stream, configuration): runs}.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for run in runs:
        groups.setdefault((run["stream"], run["config_name"]), []).append(run)
    return groups


def _worsening(figure: str, old: Sequence[float], new: Sequence[float]) -> float:
    before, now = float(np.mean(old)), float(np.mean(new))
    better = METRICS[meaning(figure)].better
    if better == "higher":
        return before - now
    return abs(now) - abs(before) if better == "nearer 0" else now - before


def _show(figure: str, values: Sequence[float]) -> str:
    return format_score(meaning(figure), values)


def _finite(values: Sequence[float]) -> bool:
    return bool(np.isfinite(values).all())
