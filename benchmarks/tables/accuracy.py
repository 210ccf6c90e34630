"""Tables of errors: a furnished house beside the peers, real places, and what each part brings."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

from benchmarks import records
from benchmarks.accuracy import unseen
from benchmarks.accuracy.gradient_parts import Part
from benchmarks.accuracy.results import load_peers
from benchmarks.tables.markdown import lay_out
from hiosdf_jax.scoring import format_score

_HOUSE = {"house_depth": "depth camera", "house_lidar": "LiDAR"}
_SCENES = {"house_depth": "house, depth camera", "house_lidar": "house, LiDAR", "demo": "demo"}
_REAL = {"kitchen_depth": "kitchen", "hall_lidar": "hall"}
_QUANTILES = ("median_cm", "p90_cm")
_PRESETS = ("default", "paper", "light")
_MESHES = ("default", "light")

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
    """Distances of held-out returns from the surface of the map, and from its mesh."""
    rows = []
    for stream, place in _REAL.items():
        for config in _PRESETS:
            if entry := _figures(stream, config):
                mean = entry["mean"]["blended"]
                cells = [
                    " / ".join(filter(None, (_score(mean, f"{part}{m}") for m in _QUANTILES)))
                    for part in ("", "mesh_")
                ]
                rows.append([f"{place}, `Config.{config}`", *cells, str(len(entry["seeds"]))])
    columns = ["from the map", "from its mesh", "seeds"]
    return lay_out(["held-out returns, cm: median / 90 % below", *columns], rows)


def parts() -> str:
    """What the grid and the network bring to the distance that is served."""
    metrics = ("visible_cm", "thin_share", "cosine", "eikonal")
    names = {"grid": "the grid alone", "network": "the network alone", "blended": "both, as served"}
    rows = []
    for stream, scene in _SCENES.items():
        for variant, label in names.items():
            mean = _figures(stream, "default")["mean"][variant]
            rows.append([f"{scene}: {label}", *(_score(mean, metric) for metric in metrics)])
    columns = ["error, cm", "thin parts", "1 - cos of the gradient", "abs(norm - 1)"]
    return lay_out(["`Config.default`", *columns], rows)


def unseen_space() -> str:
    """Errors of each part of a map in unseen space."""
    record, rows = records.read(unseen.RECORD), []
    for config in ("light", "default"):
        for (low, high), row in zip(
            itertools.pairwise(unseen.DEPTHS_M), record[config]["rows"], strict=True
        ):
            label = f"`Config.{config}`, {100 * low:.0f} to {100 * high:.0f} cm deep"
            errors = (row["error_cm"][name] for name in ("grid", "network", "blended"))
            rows.append([label, f"{row['points']:,}", *(f"{error:.1f}" for error in errors)])
    columns = ["points", "the grid alone", "the network alone", "both, as served"]
    return lay_out(["error in unseen space, cm", *columns], rows)


def ablation() -> str:
    """What each part of the pipeline brings on the first 20 frames of the LiDAR."""
    rows = []
    for label, entry in records.read(_RECORD)["house_lidar"].items():
        config, _, change = label.partition(", ")
        if config == "light" and change:
            rows.append([change, *_checks(entry["mean"]["blended"], entry["mean"]["network"])])
    columns = ["error, cm", "recall / false", "its network, cm", "recall / false"]
    return lay_out(["`Config.light`, 20 LiDAR frames", *columns], rows)


def mesh() -> str:
    """The mesh of the house, ours beside Open3D's."""
    names = [f"Open3D TSDF {edge} cm" for edge in (10, 5, 2)]
    figures = {f"{name[:11]}, {name[12:]} voxels": _peer("house_depth", name) for name in names}
    figures |= {f"`Config.{c}`, 10 cm voxels": _blended("house_depth", c) for c in _MESHES}
    metrics = ("mesh_accuracy_cm", "mesh_completeness_cm", "mesh_sdf_cm")
    rows = []
    for label, scores in figures.items():
        shares = [_score(scores, f"mesh_f_{tolerance}cm") for tolerance in (1, 2, 5)]
        rows.append([label, *(_score(scores, metric) for metric in metrics), " / ".join(shares)])
        rows[-1].append(_score(scores, "mesh_thin_share"))
    columns = ["accuracy, cm", "completeness, cm", "distance to the mesh, cm"]
    columns += ["F-score at 1 / 2 / 5 cm", "thin parts"]
    return lay_out(["house, depth camera", *columns], rows)


def steps() -> str:
    """How the distance changes along 2.5 mm, and gradients."""
    metrics = ("steps_ppm", "step_largest_cm", "far_flips_ppm", "cosine", "eikonal")
    rows = [
        [f"{scene}, `Config.{config}`", *(_score(_blended(stream, config), m) for m in metrics)]
        for stream, scene in _SCENES.items()
        for config in ("default", "light")
    ]
    columns = ["changes > 5 mm", "largest, cm", "sign changes far from surfaces"]
    columns += ["1 - cos of the gradient", "abs(norm - 1)"]
    return lay_out(["of a million segments", *columns], rows)


def gradient_parts() -> str:
    """What the error of the gradient near surfaces is made of, before and now."""
    record = records.read(records.RESULTS / "gradient_parts.json")
    both = [
        {reason: Part(**part) for reason, part in record[when]["parts"].items()}
        for when in ("before", "now")
    ]
    rows = [
        [
            reason,
            *(f"{100 * parts[reason].share:.1f} %" for parts in both),
            *(f"{parts[reason].error:.3f}" for parts in both),
        ]
        for reason in both[0]
    ]
    sums = [sum(part.error for part in parts.values()) for parts in both]
    rows.append(["all", "100 %", "100 %", *(f"{total:.3f}" for total in sums)])
    columns = ["points, before", "now", "part of the mean error, before", "now"]
    return lay_out(["first reason that holds", *columns], rows)


def training() -> str:
    """The paper's network alone, with the paper's samples and epochs."""
    rows = []
    for label, entry in records.read(_RECORD)["house_depth"].items():
        config, _, change = label.partition(", ")
        if config == "paper" and change and "=" not in change:
            mean, half = entry["mean"]["network"], entry["half_range"]["network"]
            error = f"{_score(mean, 'visible_cm')} ± {_score(half, 'visible_cm')}"
            rows.append([change, error, *(_score(mean, m) for m in ("cosine", "eikonal"))])
    columns = ["error, cm", "1 - cos of the gradient", "abs(norm - 1)"]
    return lay_out(["`Config.paper`, house, depth camera", *columns], rows)


TABLES = {
    "accuracy": house,
    "accuracy-spread": spread,
    "parts": parts,
    "real": real,
    "ablation": ablation,
    "mesh": mesh,
    "steps": steps,
    "gradient-parts": gradient_parts,
    "unseen-space": unseen_space,
    "training": training,
}

_RECORD = records.RESULTS / "accuracy.json"


def _figures(stream: str, config: str) -> dict[str, Any]:
    return records.read(_RECORD)[stream].get(config, {})


def _blended(stream: str, config: str) -> Figures:
    return _figures(stream, config)["mean"]["blended"]


def _peer(stream: str, name: str) -> Figures:
    return {metric: values[0] for metric, values in load_peers()[stream][name].items()}


def _checks(*streams: Figures) -> list[str]:
    """The error, and recall / false-alarm rate of sphere collision checks, of each stream."""
    cells = []
    for figures in streams:
        checks = [_score(figures, metric) for metric in ("recall", "fpr")]
        cells += [_score(figures, "visible_cm"), " / ".join(filter(None, checks))]
    return cells


def _score(figures: Figures, metric: str) -> str:
    return format_score(metric, figures[metric]) if metric in figures else ""
