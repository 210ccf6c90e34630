"""Tables of refined poses, tracked streams, found places and joined maps."""

from __future__ import annotations

from typing import Any

from benchmarks import records
from benchmarks.pose_record import RECORD
from benchmarks.tables.markdown import lay_out

_PLACES = {
    "house_depth": "house_depth",
    "house_lidar": "house_lidar",
    "demo": "the apartment",
    "kitchen_depth": "kitchen_depth (real)",
    "hall_lidar": "hall_lidar (real)",
}

_OFF = {
    "0 cm, 0 degrees": "exact",
    "5 cm, 3 degrees": "5 cm and 3 degrees off",
    "15 cm, 6 degrees": "15 cm and 6 degrees off",
}

_REFINED = [
    ("house_depth", "default"),
    ("house_depth", "light"),
    ("house_lidar", "light"),
    ("demo", "light"),
]

_GIVEN = {
    "exact": "exact, not refined",
    "jitter unrefined": "2 cm and 1 degree off, not refined",
    "jitter": "2 cm and 1 degree off",
    "jitter smoothed": "2 cm and 1 degree off, smoothed, mapped again three times",
    "drift unrefined": "odometry that drifts, not refined",
    "drift": "odometry that drifts",
    "drift known": "odometry that drifts, as a prior",
    "none": "only the first pose",
    "KISS-ICP": "only the first pose, by KISS-ICP",
}

_MERGED = {
    "one pass": "one pass",
    "one pass, moved and moved back": "one pass, moved by 37 degrees and moved back",
    "two halves, merged": "two halves, merged",
    "the same, one turned": "the same, the second half mapped in a frame turned by 37 degrees",
    "one pass in that frame": "one pass in that frame",
    "a loop with drift": (
        "a loop of eight submaps that drifts by 20 cm and 2 degrees, not corrected"
    ),
    "the same, corrected": "the same, corrected",
}

_SEARCHED = {
    ("house_depth", "100 in its own map"): ("house_depth", "the whole stream"),
    ("house_depth", "30 in the map of 60 frames"): ("its second half", "its first half"),
    ("kitchen_depth", "17 in the map house_depth"): ("kitchen_depth (real)", "house_depth"),
    ("hall_lidar", "89 in its own map"): ("hall_lidar (real)", "the whole stream"),
}


def refining() -> str:
    """Errors of refined poses of frames that the map was not given."""
    rows = []
    for stream, config in _REFINED:
        figures = _rows("refining", f"{stream}, {config}, all frames")
        for name, given in _OFF.items():
            row = figures[name]
            errors = [f"{row[f'{k}_cm']:.2f} cm, {row[f'{k}_deg']:.3f}°" for k in ("median", "p95")]
            label = [_PLACES[stream], f"`{config}`", given]
            rows.append([*label, _count(row, "poses"), *errors])
            rows[-1] += [f"{row['most_cm']:.2f} cm", f"{row['normalized_square']:.1f}"]
    columns = [
        "`Config`",
        "given poses",
        "poses",
        "median",
        "95th percentile",
        "most",
        "NEES (6 expected)",
    ]
    return lay_out(["held-out frames", *columns], rows)


def tracking() -> str:
    """Errors of the poses and maps of streams whose poses are off or missing."""
    rows = []
    for stream, label in _PLACES.items():
        for name, row in _rows("tracking", stream).items():
            mode, _, seed = name.partition(", ")
            if mode not in _GIVEN:
                continue
            given = _GIVEN[mode] + (f" ({seed})" if seed else "")
            refused = ""
            if "frames" in row and "exact" not in mode and "unrefined" not in mode:
                refused = f"{_count(row, 'not_registered')} of {_count(row, 'frames')}"
            errors = [_cm(row[key]) for key in ("rms_cm", "end_cm")]
            errors.append(f"{row['map_cm']:.2f} cm" if "map_cm" in row else "")
            rows.append([label, given, refused, *errors])
    columns = ["given poses", "not registered", "positions (RMSE)", "last position", "map"]
    return lay_out(["`Config.light`, errors", *columns], rows)


def wrong_poses() -> str:
    """Counts of wrong poses that pass as right ones."""
    rows = []
    for stream, label in _PLACES.items():
        figures = _rows("wrong poses", stream)
        if not figures:
            continue
        right, *wrong = (figures[name] for name in ("right", "1 m off", "0.5 m off"))
        cells = [label, f"{_count(right, 'refused')} of {_count(right, 'tried')}"]
        for row in wrong:
            cells += [_count(row, key) for key in ("tried", "enough_inliers", "taken")]
        rows.append(cells)
    columns = ["right ones refused"]
    for distance in ("1 m", "0.5 m"):
        columns += [f"poses {distance} off", "wrong ones with 70 % inliers", "wrong ones taken"]
    return lay_out(["`Config.light`, seed 0", *columns], rows)


def places() -> str:
    """Counts of places that were found, and how sure they are."""
    keys = ("found", "sure", "wrong", "wrong_converged", "wrong_sure")
    rows = []
    for (stream, where), (frames, mapped) in _SEARCHED.items():
        row = _rows("places", stream)[where]
        counts = [_count(row, key) for key in keys]
        rows.append([f"{_count(row, 'tried')} of {frames}", mapped, *counts])
    columns = ["right places", "of these sure", "wrong places", "of these converged"]
    return lay_out(["frames", "map", *columns, "of these sure"], rows)


def merging() -> str:
    """Errors of maps that were moved, merged and corrected."""
    figures = _rows("merging", "house_depth")
    rows = [
        [
            label,
            f"{figures[name]['visible_cm']:.2f}",
            f"{figures[name]['recall']:.3f}",
            f"{figures[name]['fpr']:.4f}",
        ]
        for name, label in _MERGED.items()
    ]
    return lay_out(["`Config.light`", "error, cm", "recall", "false alarms"], rows)


TABLES = {
    "refining": refining,
    "tracking": tracking,
    "wrong-poses": wrong_poses,
    "places": places,
    "merging": merging,
}


def _rows(part: str, stream: str) -> dict[str, dict[str, Any]]:
    return records.read(RECORD)[part].get(stream, {})


def _count(row: dict[str, Any], key: str) -> str:
    return f"{row[key]:,.0f}"


def _cm(value: float) -> str:
    return f"{value:,.0f} cm" if value >= 100 else f"{value:.1f} cm"
