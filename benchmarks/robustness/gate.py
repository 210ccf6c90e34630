"""Which figures are worse than in the committed baseline.

A figure is worse if its mean over the seeds has moved the wrong way by more than the largest of
three standard errors of the difference, a floor for its unit, and 10 % of the baseline if it is not
a share.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import records
from benchmarks.robustness.figures import FIGURES, Results

BASELINE = Path(__file__).parents[1] / "results" / "robustness_baseline.json"

_ERRORS = 3.0
_RELATIVE = {"cm": 0.1, "share": 0.0, "ratio": 0.1}
_FLOORS = {"cm": 0.3, "share": 0.02, "ratio": 0.05}


class Verdict(NamedTuple):
    """What a comparison found; lines for a terminal.

    Attributes:
        worse: Figures that got worse, or are missing.
        better: Figures that got better by as much.
        compared: Number of figures compared.
    """

    worse: list[str]
    better: list[str]
    compared: int


def update_baseline(path: Path, config_name: str, record: dict[str, Any]) -> None:
    """Writes a run into a baseline; rows that were not run stay.

    Args:
        path: The file.
        config_name: Name of the configuration.
        record: {"device", "jax", "revision", "seeds", "rows"}.
    """
    _update(path, config_name, record, lambda each: [records.rounded(one, 4) for one in each])


def update_means(path: Path, config_name: str, record: dict[str, Any]) -> None:
    """Writes the means of a run over its seeds into a record; rows that were not run stay.

    Args:
        path: The file.
        config_name: Name of the configuration.
        record: {"device", "jax", "revision", "seeds", "rows"}.
    """
    _update(path, config_name, record, lambda each: records.rounded(float(np.mean(each)), 4))


def compare(old: Results, new: Results) -> Verdict:
    """Compares results with those of a baseline.

    Args:
        old: The baseline's.
        new: Those of a run; rows that it left out are not compared.

    Returns:
        The verdict.
    """
    verdict = Verdict([], [], 0)
    for row, figures in new.items():
        for name, recorded in old.get(row, {}).items():
            verdict = verdict._replace(compared=verdict.compared + 1)
            before = np.array(recorded, float)  # a record has null for NaN
            after = np.array(figures.get(name, [np.nan]))
            change = _worsening(name, before, after)
            line = f"{row}: {name} {np.mean(before):.3g} -> {np.mean(after):.3g}"
            if not change <= _tolerance(name, before, after):  # also catches NaN
                verdict.worse.append(line)
            elif change < -_tolerance(name, before, after):
                verdict.better.append(line)
    return verdict


def _update(
    path: Path, config_name: str, record: dict[str, Any], kept: Callable[[list[float]], Any]
) -> None:
    """Writes of each figure what `kept` makes of its values by seed."""
    written = records.read(path)
    measured = {
        row: {name: kept(values) for name, values in each.items()}
        for row, each in record["rows"].items()
    }
    old = written.get(config_name, {"rows": {}})
    if not old["rows"].keys() <= measured.keys():  # rows of both runs are in it
        record = record | {
            key: ", ".join(dict.fromkeys([*old[key].split(", "), record[key]]))
            for key in ("device", "jax", "revision")
            if key in old
        }
    written[config_name] = record | {"rows": old["rows"] | measured}
    records.write(path, written)


def _worsening(name: str, old: np.ndarray, new: np.ndarray) -> float:
    before, after = float(np.mean(old)), float(np.mean(new))
    better = FIGURES[name].better
    if better == "higher":
        return before - after
    return abs(after) - abs(before) if better == "nearer 0" else after - before


def _tolerance(name: str, old: np.ndarray, new: np.ndarray) -> float:
    freedom = len(old) + len(new) - 2
    squares = sum(float(np.var(side)) * len(side) for side in (old, new))
    spread = np.sqrt(squares / freedom) if freedom else 0.0
    error = spread * np.sqrt(1 / len(old) + 1 / len(new))
    unit = FIGURES[name].unit
    bounds = [_ERRORS * error, _RELATIVE[unit] * abs(np.mean(old)), _FLOORS[unit]]
    return float(np.nanmax(bounds))
