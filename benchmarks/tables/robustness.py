"""Tables of changing worlds and faulty sensors: bars met and missed, errors by fault."""

from __future__ import annotations

from typing import Any

from benchmarks import records
from benchmarks.robustness import figures
from benchmarks.robustness import vanishing as vanish
from benchmarks.tables.markdown import lay_out

Checks = dict[tuple[str, str], figures.Check]


def bars() -> str:
    """How many bars are met, by what happens."""
    checks = [_checks(name) for name in _CONFIGS]
    cells = []
    for start, label in _HAPPENINGS.items():
        counted = [
            [one.met for (row, _), one in each.items() if row.startswith(start)] for each in checks
        ]
        cells.append([label, *(f"{sum(met)} of {len(met)}" for met in counted)])
    return lay_out(["bars met", *_columns()], cells)


def missed() -> str:
    """The figures that miss their bar."""
    checks = [_checks(name) for name in _CONFIGS]
    cells = []
    for (row, figure), first in checks[0].items():
        found = [each[row, figure] for each in checks]
        if not all(one.met for one in found):
            upper = figures.FIGURES[figure].better == "lower"
            bar = f"at most {first.bar.most:g}" if upper else f"at least {first.bar.least:g}"
            cells.append([row, f"`{figure}`", *(f"{one.value:.3g}" for one in found), bar])
    return lay_out(["figures that miss their bar", "", *_columns(), "bar"], cells)


def faults() -> str:
    """Errors of maps of the house after faults, as multiples of the clean map's."""
    results = [_rows(name) for name in _CONFIGS]
    cells = [
        [row.removeprefix("house: "), *(f"{each[row]['error_ratio']:.2f}" for each in results)]
        for row, measured in results[0].items()
        if row.startswith("house: ") and "error_ratio" in measured
    ]
    return lay_out(["error with a fault : error without", *_columns()], cells)


def vanishing() -> str:
    """Scans until the place of a thing that has left is free."""
    record = records.read(vanish.RECORD)
    sensors = {"camera": "camera", "lidar": "LiDAR"}
    rows = [
        [
            "3 (default)" if vanish_scans == "3" else vanish_scans,
            *(_scans(found[sensor][answer]) for sensor in sensors for answer in vanish.ANSWERS),
        ]
        for vanish_scans, found in record["vanish_scans"].items()
    ]
    columns = [
        f"{label}: `{answer}`" if answer != "network" else f"{label}: the network alone"
        for label in sensors.values()
        for answer in vanish.ANSWERS
    ]
    return lay_out(["`vanish_scans`", *columns], rows)


TABLES = {
    "robustness-bars": bars,
    "robustness-missed": missed,
    "robustness-faults": faults,
    "vanishing": vanishing,
}

_RECORD = records.RESULTS / "robustness.json"
_CONFIGS = {"light": "`Config.light`, CPU", "default": "`Config.default`, H200"}
_HAPPENINGS = {
    "": "all",
    "stands": "a box stands from the start",
    "appears": "a box appears",
    "jumps": "a box jumps by 1.4 m",
    "crosses": "a box crosses the view",
    "walks": "a person walks",
    "arm": "the robot's arm is in view",
    "apartment": "an apartment with a door, a chair and a person",
    "house": "faults of the sensor and of poses",
}


def _scans(freed: dict[str, Any]) -> str:
    """A number of scans, or the share that is free after the last one."""
    if freed["scans"] is None:
        return f"not in {vanish.MOST_SCANS} ({freed['share']:.2f})"
    return str(freed["scans"])


def _columns() -> list[str]:
    return list(_CONFIGS.values())


def _rows(config: str) -> dict[str, dict[str, float]]:
    return records.read(_RECORD)[config]["rows"]


def _checks(config: str) -> Checks:
    rows = {
        row: {name: [value] for name, value in each.items()} for row, each in _rows(config).items()
    }
    return {(one.row, one.bar.figure): one for one in figures.check(rows)}
