"""Tables of errors: a furnished house beside the peers, real places, and what each part brings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks import records
from benchmarks.accuracy.results import load_peers
from benchmarks.tables.markdown import lay_out
from hiosdf_jax.scoring import format_score

_HOUSE = {"house_depth": "depth camera", "house_lidar": "LiDAR"}
_REAL = {"kitchen_depth": "kitchen", "hall_lidar": "hall"}
_PRESETS = ("default", "paper", "light")

_PEERS = {
    "Voxfield 10 cm": "Voxfield, 10 cm",
    "Voxfield 5 cm": "Voxfield, 5 cm",
    "HIO-SDF": "HIO-SDF (the paper's network over Voxfield)",
    "iSDF": "iSDF",
    "OREN": "OREN",
}

# What a row shows: a configuration, and how its map is asked.
_OURS = {
    "our grid alone, 10 cm": ("default", "grid"),
    "`Config.paper`: the network alone": ("paper", "blended"),
    "`Config.default`": ("default", "blended"),
    "its network alone": ("default", "network"),
    "`Config.light`": ("light", "blended"),
}

Figures = Mapping[str, Any]


def house() -> str:
    """Errors and collision checks in a furnished house, ours beside the peers'."""
    peers = load_peers()
    figures = {
        label: [peers[stream].get(name, {}) for stream in _HOUSE] for name, label in _PEERS.items()
    }
    figures |= {
        label: [_figures(stream, config)["mean"][variant] for stream in _HOUSE]
        for label, (config, variant) in _OURS.items()
    }
    columns = [column for sensor in _HOUSE.values() for column in (sensor, "recall / false")]
    rows = [[label, *_checks(*streams)] for label, streams in figures.items()]
    return lay_out(["a furnished house, 19 x 11 m", *columns], rows)


def spread() -> str:
    """The same errors with half of their range over the seeds, and what is kept of thin parts."""
    rows = []
    for config in _PRESETS:
        cells = [f"`Config.{config}`"]
        for stream in _HOUSE:
            entry = _figures(stream, config)
            mean, half_range = entry["mean"]["blended"], entry["half_range"]["blended"]
            for metric in ("visible_cm", "thin_share"):
                cells.append(f"{_score(mean, metric)} ± {_score(half_range, metric)}")
            cells.append(str(len(entry["seeds"])))
        rows.append(cells)
    columns = [
        column for sensor in _HOUSE.values() for column in (f"{sensor}, cm", "thin parts", "seeds")
    ]
    return lay_out(["mean ± half of the range", *columns], rows)


def real() -> str:
    """Distances of held-out returns from the surface of the map."""
    rows = []
    for config in _PRESETS:
        entries = [_figures(stream, config) for stream in _REAL]
        means = [entry["mean"]["blended"] if entry else {} for entry in entries]
        scores = [_score(mean, metric) for mean in means for metric in ("median_cm", "p90_cm")]
        rows.append([f"`Config.{config}`", *scores])
    columns = [f"{place}, {part}" for place in _REAL.values() for part in ("median", "90 % below")]
    return lay_out(["held-out returns, cm", *columns], rows)


def ablation() -> str:
    """What each part of the pipeline brings on the first 20 frames of the LiDAR."""
    rows = []
    for label, entry in records.read(_RECORD)["house_lidar"].items():
        config, _, change = label.partition(", ")
        if config == "light" and change:
            rows.append([change, *_checks(entry["mean"]["blended"], entry["mean"]["network"])])
    columns = ["error, cm", "recall / false", "its network, cm", "recall / false"]
    return lay_out(["`Config.light`, 20 LiDAR frames", *columns], rows)


def slopes() -> str:
    """Errors of `Config.paper` with the slopes of all samples, and of half of them."""
    rows = []
    for label, config in (("all samples", "paper"), ("half of them", "paper, eikonal_every=2")):
        means = [_figures(stream, config)["mean"]["blended"] for stream in (*_HOUSE, *_REAL)]
        metrics = ("visible_cm", "visible_cm", "median_cm", "median_cm")
        rows.append([label, *map(_score, means, metrics)])
    columns = [f"house, {sensor}" for sensor in _HOUSE.values()] + list(_REAL.values())
    return lay_out(["Eikonal loss on", *columns], rows)


TABLES = {
    "accuracy": house,
    "accuracy-spread": spread,
    "real": real,
    "ablation": ablation,
    "slopes": slopes,
}

_RECORD = records.RESULTS / "accuracy.json"


def _figures(stream: str, config: str) -> dict[str, Any]:
    return records.read(_RECORD)[stream].get(config, {})


def _checks(*streams: Figures) -> list[str]:
    """The error, and recall / false-alarm rate of sphere collision checks, of each stream."""
    cells = []
    for figures in streams:
        checks = [_score(figures, metric) for metric in ("recall", "fpr")]
        cells += [_score(figures, "visible_cm"), " / ".join(filter(None, checks))]
    return cells


def _score(figures: Figures, metric: str) -> str:
    return format_score(metric, figures[metric]) if metric in figures else ""
