"""The report of a run: `metrics.json`, and the summary that the terminal shows."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.command.map_frames import Mapped
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.scoring import table
from hiosdf_jax._src.state.flags import Flag

FLAG_WORDS = {
    Flag.BAD_POSE: "a pose was not finite or not rigid",
    Flag.EMPTY_CLOUD: "a cloud had no return",
    Flag.POINTS_OUTSIDE: "points in range fell outside the bounds and left no surface",
    Flag.TRAINING_FAILED: "a training step was not finite and was undone",
    Flag.OUT_OF_RANGE: "a cloud had almost no return in range and was refused: is its unit m?",
    Flag.INCONSISTENT_CLOUD: "a cloud contradicted the map: check the pose and the sensor",
    Flag.BAD_ARGUMENT: "the robot's spheres or the noise had bad values",
    Flag.NOT_REGISTERED: "a cloud did not fit the map at any pose near its own, and was left out",
    Flag.FUSED_AS_PREDICTED: "a cloud of the young map was fused at its own pose",
}


def describe(mapped: Mapped, config: Config) -> dict[str, Any]:
    """Lists everything about a map but its scores.

    Args:
        mapped: The map.
        config: Its configuration.

    Returns:
        Counts, times, flags, the configuration and the device, by the keys of `metrics.json`.
    """
    updates, flags = int(mapped.state.updates), int(mapped.state.report.flags)
    times_ms = 1000 * mapped.update_seconds
    before = max(updates - len(times_ms), 0)  # in the run that this one continues
    warm = max(config.warmup_updates - before, 1)  # they train longer, and the first one compiles
    warmup_ms, later_ms = times_ms[1:warm], times_ms[warm:]
    return {
        "updates": updates,
        "frames_skipped": mapped.skipped,
        "stopped_by": None if mapped.stopped is None else str(mapped.stopped),
        "compile_s": float(mapped.update_seconds[0]) if len(mapped.update_seconds) else math.nan,
        "warmup_median_ms": float(np.median(warmup_ms)) if len(warmup_ms) else math.nan,
        "update_median_ms": float(np.median(later_ms)) if len(later_ms) else math.nan,
        "update_p90_ms": float(np.percentile(later_ms, 90)) if len(later_ms) else math.nan,
        "points_used": mapped.progress.points_used,
        "points_outside": mapped.progress.points_outside,
        "flags": [str(flag.name) for flag in Flag if flags & flag],
        "config": dataclasses.asdict(config),
        "device": jax.devices()[0].device_kind,
    }


def summarize(metrics: dict[str, Any]) -> str:
    """Formats the metrics of a run for a terminal.

    Args:
        metrics: From `describe`, with `scores` and `bands`, or `held_out`, if the map was scored.

    Returns:
        Several lines.
    """
    times = [
        f"first {metrics['compile_s']:.1f} s (it compiles)",
        f"{metrics['warmup_median_ms']:.0f} ms while warming up",
        f"then {metrics['update_median_ms']:.0f} ms (median)",
        f"{metrics['update_p90_ms']:.0f} ms (90 % below)",
    ]
    measured = [each for each in times if "nan" not in each] or ["none of them in this run"]
    lines = [f"{metrics['updates']} updates on {metrics['device']}: {', '.join(measured)}"]
    if metrics["frames_skipped"]:
        lines.append(f"{metrics['frames_skipped']} frames could not be used and were skipped")
    if "frames_registered" in metrics:
        missed = metrics["frames_not_registered"]
        lines.append(f"{metrics['frames_registered']} frames were registered, {missed} were not")
        if metrics["frames_as_predicted"]:
            lines[-1] += f", {metrics['frames_as_predicted']} of a young map are as predicted"
        if metrics["lost_since"] is not None:
            lines.append(
                f"lost since frame {metrics['lost_since']}: frames must overlap, and be within "
                "about 10 cm and 5 degrees of their prediction"
            )
    if metrics["stopped_by"]:
        lines.append(f"ended early by {metrics['stopped_by']}")
    for flag in metrics["flags"]:
        words = FLAG_WORDS[Flag[flag]]
        if flag == Flag.POINTS_OUTSIDE.name:
            outside = metrics["points_outside"]
            words += f" ({outside} of {outside + metrics['points_used']})"
        lines.append(f"flag {flag}: {words}")
    scores = metrics.get("scores") or metrics.get("held_out")
    if scores:
        lines += ["", table.format_table(scores), ""]
    if "not_scored" in metrics:
        lines += [table.format_reasons(metrics["not_scored"]), ""]
    if "bands" in metrics:
        lines += [table.format_bands(metrics["bands"]), ""]
    return "\n".join(lines)


def write_json(path: Path, value: Any) -> None:
    """Writes nested dicts, lists, tuples and scalars to a JSON file.

    Args:
        path: The file.
        value: What to write; numbers that are not finite become null.

    Raises:
        OSError: The file cannot be written.
    """
    text = json.dumps(to_json(value), indent=2) + "\n"
    with replacing(path) as file:
        file.write(text.encode())


def to_json(value: Any) -> Any:
    """Replaces what JSON cannot represent.

    Args:
        value: Nested dicts, lists, tuples and scalars.

    Returns:
        The same, with lists for tuples and None for numbers that are not finite.
    """
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
