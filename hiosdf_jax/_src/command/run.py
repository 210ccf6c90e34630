"""A stream from end to end: mapped, scored, and drawn into a folder."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame
from hiosdf_jax._src.field.points import query, sdf, sdf_and_grad
from hiosdf_jax._src.mapping import checkpoint, pipeline
from hiosdf_jax._src.scoring import metrics as scoring
from hiosdf_jax._src.scoring.metrics import GroundTruth
from hiosdf_jax._src.state import Field, Flag, MapState
from hiosdf_jax._src.view import drawing

# Of a stream without ground truth the map is not given every tenth frame, once it has seen some.
_FIRST_HELD_OUT = 15
_HOLD_OUT_EVERY = 10
_HELD_OUT_POINTS = 20_000  # over all these frames

_FLAG_WORDS = {
    Flag.BAD_POSE: "a pose was not finite or not rigid",
    Flag.EMPTY_CLOUD: "a cloud had no return",
    Flag.POINTS_OUTSIDE: "points in range fell outside the bounds and left no surface",
    Flag.TRAINING_FAILED: "a training step was not finite and was undone",
}


class NothingMappedError(Exception):
    """No frame of a stream could be mapped."""


@dataclasses.dataclass(frozen=True)
class Mapped:
    """What mapping a stream gave.

    Attributes:
        state: The map after the last frame.
        path_world: (F, 3) m, the sensor's positions in the frames that were mapped.
        up_world: (3,) unit vector against gravity, as well as the sensor's poses tell.
        update_seconds: (F,) s, of each update, until its result was there.
        last_frame: Index of the last frame that was mapped.
        skipped: Frames that could not be used and were passed over.
        stopped: What ended the mapping before the last frame, if anything did.
        held_out_world: (M, 3) float32 m, returns of the frames that the map was not given.
        points_used: Points that were fused, over all frames.
        points_outside: Points in range that lay outside the bounds, over all frames.
    """

    state: MapState
    path_world: np.ndarray
    up_world: np.ndarray
    update_seconds: np.ndarray
    last_frame: int
    skipped: int
    stopped: BadFrameError | None
    held_out_world: np.ndarray
    points_used: int
    points_outside: int


def run_stream(
    stream: Stream,
    config: Config,
    output: str | os.PathLike[str],
    *,
    name: str,
    seed: int = 0,
    truth: GroundTruth | None = None,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None = None,
    save_path: str | os.PathLike[str] | None = None,
    skip_bad_frames: bool = False,
) -> dict[str, Any]:
    """Maps a stream, then writes what came of it into a folder and prints the scores.

    The folder gets `metrics.json`, `slices.png`, `mesh.ply` and `mesh.png`. A stream without
    ground truth is scored on the returns of every tenth frame, which the map is not given.

    A frame that cannot be used ends the mapping: what was mapped before it is still written, since
    it is as good as ever, and then the error is raised.

    Args:
        stream: The frames.
        config: The map's configuration.
        output: The folder; made if it is not there.
        name: What the stream is called in `metrics.json`.
        seed: Of the map's randomness.
        truth: Exact distances to score against.
        exact_sdf: Maps (n, 3) points in the world, m, to (n,) exact distances, m; drawn beside the
            map.
        save_path: Where to write the map itself, see `hiosdf_jax.load`.
        skip_bad_frames: Pass over frames that cannot be used, and count them.

    Returns:
        What `metrics.json` holds.

    Raises:
        BadFrameError: A frame cannot be used.
        NothingMappedError: No frame could be mapped.
        OSError: The folder or a file in it cannot be written.
    """
    output = Path(output)
    output.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    held_out = held_out_frames(len(stream)) if truth is None else range(0)
    mapped = map_frames(
        stream, config, jax.random.key(seed), held_out=held_out, skip_bad_frames=skip_bad_frames
    )
    if save_path is not None:
        checkpoint.save(save_path, mapped.state)
    field = pipeline.snapshot(mapped.state)

    metrics = _describe(mapped, config) | {"stream": name, "seed": seed}
    if truth is not None:
        for name, score in (("scores", scoring.evaluate), ("bands", scoring.evaluate_bands)):
            metrics[name] = score(
                lambda points: sdf_and_grad(field, points),
                truth,
                sensor_position_world=mapped.path_world[-1],
                last_frame=mapped.last_frame,
            )
        metrics["scores"] |= scoring.evaluate_lower(
            lambda points: _lower(field, points), truth, mapped.last_frame
        )
    elif held_out:
        metrics["held_out"] = _score_held_out(field, mapped.held_out_world)
    print(_summary(metrics))

    _give_back_freed_memory()
    print("drawing slices.png, mesh.ply and mesh.png")
    up_world = drawing.draw_map(output, field, exact_sdf, mapped.path_world, mapped.up_world)
    metrics["up_world"] = up_world.tolist()
    metrics["total_s"] = time.perf_counter() - start
    (output / "metrics.json").write_text(json.dumps(to_json(metrics), indent=2) + "\n", "utf-8")
    print(f"wrote {output}{os.sep} in {metrics['total_s']:.0f} s")
    if mapped.stopped is not None:
        raise mapped.stopped
    return metrics


def map_frames(
    stream: Stream,
    config: Config,
    key: jax.Array,
    *,
    held_out: Sequence[int] = (),
    skip_bad_frames: bool = False,
) -> Mapped:
    """Maps the frames of a stream one by one, with a progress bar.

    Args:
        stream: The frames.
        config: The map's configuration.
        key: Source of the map's randomness.
        held_out: Indices of frames to keep from the map; their returns are in the result.
        skip_bad_frames: Tell of frames that cannot be used on stderr and go on. By default the
            first one ends the mapping.

    Returns:
        The map and what became of the frames.

    Raises:
        BadFrameError: A frame cannot be used and nothing was mapped before it.
        NothingMappedError: No frame could be mapped.
    """
    from tqdm import tqdm

    state = pipeline.init(config, key)
    seconds, path_world, ups_world = [], [], []
    kept_world, kept_rng = [np.empty((0, 3), np.float32)], np.random.default_rng(0)
    points_used = points_outside = skipped = last_frame = 0
    stopped = None
    bar = tqdm(range(len(stream)), desc="mapping", unit="frame")
    for i in bar:
        try:
            cloud, pose = read_frame(stream, i)
        except BadFrameError as error:
            if not skip_bad_frames:
                stopped = error
                break
            skipped += 1
            tqdm.write(str(error), file=sys.stderr)
            continue
        if i in held_out:
            kept_world.append(draw_returns(cloud, pose, config, len(held_out), kept_rng))
            continue
        start = time.perf_counter()
        state = jax.block_until_ready(pipeline.update(state, cloud, pose))
        seconds.append(time.perf_counter() - start)
        if len(seconds) == 1:
            _give_back_freed_memory()
        last_frame = i
        path_world.append(pose[:3, 3])
        ups_world.append(_up_of_frame(cloud, pose))
        points_used += int(state.report.points_used)
        points_outside += int(state.report.points_outside)
        if i % 5 == 0:
            loss_cm = 100 * float(state.report.sdf_loss)
            bar.set_postfix_str(
                f"loss {loss_cm:.1f} cm, {int(state.report.points_used)} points", refresh=False
            )
    bar.close()
    if not seconds:
        raise stopped or NothingMappedError(
            f"none of the {len(stream) - len(held_out)} frames could be mapped"
        )
    up_world = np.mean(ups_world, axis=0)
    length = np.linalg.norm(up_world)
    return Mapped(
        state=state,
        path_world=np.asarray(path_world, float),
        up_world=up_world / length if length > 0.1 else np.array([0.0, 0.0, 1.0]),
        update_seconds=np.asarray(seconds),
        last_frame=last_frame,
        skipped=skipped,
        stopped=stopped,
        held_out_world=np.concatenate(kept_world),
        points_used=points_used,
        points_outside=points_outside,
    )


def _give_back_freed_memory() -> None:
    """Hands the system what compiling has freed: 0.5 GB that glibc would keep for the process."""
    with contextlib.suppress(OSError, AttributeError):  # another libc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def held_out_frames(count: int) -> range:
    """Chooses the frames that a map is scored on and not given.

    Args:
        count: Of the stream's frames.

    Returns:
        Their indices: every tenth, from the 16th on.
    """
    return range(count)[_FIRST_HELD_OUT::_HOLD_OUT_EVERY]


def draw_returns(
    cloud: np.ndarray,
    pose: np.ndarray,
    config: Config,
    frames: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draws some of a held-out frame's returns that are in range.

    Args:
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.
        config: Of the map, which says what is in range.
        frames: How many frames are held out in all.
        rng: Source of randomness.

    Returns:
        (n, 3) m, world; 20,000 over all frames.
    """
    ranges = np.linalg.norm(cloud, axis=-1)  # NaN, which compares as False, for no return
    cloud = cloud[(ranges >= config.min_range) & (ranges <= config.max_range)]
    quota = max(_HELD_OUT_POINTS // frames, 1)
    cloud = rng.choice(cloud, min(quota, len(cloud)), replace=False)
    return cloud @ pose[:3, :3].T + pose[:3, 3]


def to_json(value: Any) -> Any:
    """Replaces what JSON cannot hold.

    Args:
        value: Of dicts, lists, tuples and scalars.

    Returns:
        The same with lists for tuples, and None for numbers that are not finite.
    """
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _up_of_frame(cloud: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The direction against gravity of a sensor that is carried upright, (3,), world.

    A camera sees only what lies in front of it, along z; its y points down. A LiDAR sees around
    itself; its z points up.
    """
    heights = cloud[np.isfinite(cloud).all(axis=-1), 2]
    return -pose[:3, 1] if (heights > 0).all() else pose[:3, 2]


def _describe(mapped: Mapped, config: Config) -> dict[str, Any]:
    """What is to be told of a map but for its scores."""
    # The first update compiles.
    later_ms = 1000 * mapped.update_seconds[1:]
    flags = int(mapped.state.report.flags)
    return {
        "updates": int(mapped.state.updates),
        "frames_skipped": mapped.skipped,
        "stopped_by": None if mapped.stopped is None else str(mapped.stopped),
        "compile_s": float(mapped.update_seconds[0]),
        "update_median_ms": float(np.median(later_ms)) if len(later_ms) else math.nan,
        "update_p90_ms": float(np.percentile(later_ms, 90)) if len(later_ms) else math.nan,
        "points_used": mapped.points_used,
        "points_outside": mapped.points_outside,
        "flags": [str(flag.name) for flag in Flag if flags & flag],
        "config": dataclasses.asdict(config),
        "device": jax.devices()[0].device_kind,
    }


def _score_held_out(field: Field, points_world: np.ndarray) -> dict[str, float]:
    """Scores a map on returns that it was not given, where it has seen the place."""
    if not len(points_world):
        return {"points": 0, "points_observed": 0}
    observed = np.asarray(query(field, points_world).observed)  # False outside the bounds
    scores: dict[str, float] = {"points": len(points_world), "points_observed": int(observed.sum())}
    if observed.any():
        scores |= scoring.held_out_surface(
            lambda points: sdf(field, points), points_world[observed]
        )
    return scores


def _summary(metrics: dict[str, Any]) -> str:
    """Lays out for a terminal what a run gave."""
    lines = [
        f"{metrics['updates']} updates on {metrics['device']}: "
        f"first {metrics['compile_s']:.1f} s (it compiles), then "
        f"{metrics['update_median_ms']:.0f} ms (median), "
        f"{metrics['update_p90_ms']:.0f} ms (90 % below)"
    ]
    if metrics["frames_skipped"]:
        lines.append(f"{metrics['frames_skipped']} frames could not be used and were passed over")
    if metrics["stopped_by"]:
        lines.append(f"ended early by {metrics['stopped_by']}")
    for flag in metrics["flags"]:
        words = _FLAG_WORDS[Flag[flag]]
        if flag == Flag.POINTS_OUTSIDE.name:
            outside = metrics["points_outside"]
            words += f" ({outside} of {outside + metrics['points_used']})"
        lines.append(f"flag {flag}: {words}")
    scores = metrics.get("scores") or metrics.get("held_out")
    if scores:
        lines += ["", scoring.format_table(scores), ""]
    if "bands" in metrics:
        lines += [scoring.format_bands(metrics["bands"]), ""]
    return "\n".join(lines)


# The map is an argument, so that this compiles once for maps of one configuration.
_lower = jax.jit(lambda field, points: query(field, points).lower)
