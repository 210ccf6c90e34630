"""The error over time, as in the paper's Fig. 7."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.results import Figures
from hiosdf_jax.scoring import METRICS

_METRICS = ("visible_cm", "within_3m_cm", "eikonal", "cosine")
_REAL_METRICS = ("median_cm", "mean_cm", "p90_cm")  # of streams without ground truth
_STYLES = {"grid": ":", "network": "--", "blended": "-"}


def save_figure(
    path: Path,
    groups: Mapping[tuple[str, str], Sequence[dict[str, Any]]],
    peers: Mapping[str, Mapping[str, Figures]],
) -> bool:
    """Draws the scores over the frames, with one row per stream and one column per metric.

    Lines are means over the seeds, and the bands around them are their range. Each configuration
    has a color. Gray level lines are the peers, of which only the last score is known.

    Args:
        path: The picture.
        groups: {(stream, configuration): runs from `measure_source`}.
        peers: {stream: {peer: figures}}.

    Returns:
        Whether it was drawn; False without matplotlib.
    """
    try:
        from matplotlib.figure import Figure  # without pyplot: no display is needed
    except ModuleNotFoundError:
        return False
    streams = list(dict.fromkeys(stream for stream, _ in groups))
    maps = list(dict.fromkeys(label for _, label in groups))
    drawing = Figure(figsize=(16, 3.2 * len(streams)), layout="constrained")
    axes = drawing.subplots(len(streams), len(_METRICS), squeeze=False)
    for row, stream in zip(axes, streams, strict=True):
        chosen = {label: group for (name, label), group in groups.items() if name == stream}
        first = next(iter(chosen.values()))[0]["variants"]["blended"]["over_time"][0]
        metrics = _METRICS if "visible_cm" in first else _REAL_METRICS
        for ax, metric in zip(row, metrics, strict=False):
            for label, group in chosen.items():
                for variant, style in _STYLES.items():
                    _draw_line(ax, group, variant, metric, f"C{maps.index(label)}", style, label)
            for peer, figures in peers.get(stream, {}).items():
                if metric in figures:
                    ends = ax.get_xlim()
                    ax.axhline(np.mean(figures[metric]), color="0.7", lw=0.8, zorder=0)
                    ax.text(ends[1], np.mean(figures[metric]), peer, fontsize=6, ha="right")
            unit = f", {METRICS[metric].unit}" if METRICS[metric].unit != "-" else ""
            ax.set(title=f"{stream}: {METRICS[metric].label}{unit}", xlabel="frame")
            ax.title.set_fontsize(8)
            ax.set_ylim(bottom=0)
        for ax in row[len(metrics) :]:
            ax.set_visible(False)
    axes[0, 0].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    return True


def _draw_line(
    ax: Any,
    group: Sequence[dict[str, Any]],
    variant: str,
    metric: str,
    color: str,
    style: str,
    label: str,
) -> None:
    frames = [entry["frame"] for entry in group[0]["variants"][variant]["over_time"]]
    values = np.array(
        [
            [entry.get(metric, np.nan) for entry in record["variants"][variant]["over_time"]]
            for record in group
        ],
        float,
    )
    ax.plot(frames, values.mean(axis=0), style, color=color, lw=1.3, label=f"{label}, {variant}")
    ax.fill_between(frames, values.min(axis=0), values.max(axis=0), color=color, alpha=0.15, lw=0)
