"""A stream from end to end: mapped, scored, drawn and reported into a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.command import report
from hiosdf_jax._src.command.map_frames import Mapped, fuse_frames, return_freed_memory
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.mapping import checkpoint, pipeline
from hiosdf_jax._src.scoring import held_out, metrics
from hiosdf_jax._src.view import drawing


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
    """Maps a stream, scores and draws the map, and writes everything into a folder.

    The folder gets `metrics.json`, `slices.png`, `mesh.ply` and `mesh.png`. Without ground truth
    the map is scored on the returns of every tenth frame, which it is not given.

    A bad frame ends the mapping. The map of the frames before it is valid, so it is still scored,
    drawn and written before the error is raised.

    Args:
        stream: The frames.
        config: The map's configuration.
        output: The folder; created if missing.
        name: Name of the stream in `metrics.json`.
        seed: Seed of the map's randomness.
        truth: Exact distances to score against.
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m; drawn beside the
            map.
        save_path: Where to write the map itself, see `hiosdf_jax.load`.
        skip_bad_frames: Skip bad frames and count them.

    Returns:
        The contents of `metrics.json`.

    Raises:
        BadFrameError: A frame is bad.
        NothingMappedError: No frame could be mapped.
        OSError: The folder or a file in it cannot be written.
    """
    output = Path(output)
    output.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    kept = held_out.held_out_frames(len(stream)) if truth is None else range(0)
    mapped = fuse_frames(
        stream, config, jax.random.key(seed), held_out=kept, skip_bad_frames=skip_bad_frames
    )
    if save_path is not None:
        checkpoint.save(save_path, mapped.state)
    queries = CompiledQueries(pipeline.snapshot(mapped.state))
    scores = {}
    if truth is not None:
        scores = _score(queries, mapped, truth)
    elif kept:
        returns_world = mapped.held_out_world
        scores["held_out"] = held_out.score_held_out(queries.sdf, queries.observed, returns_world)
    return_freed_memory()
    print("drawing slices.png, mesh.ply and mesh.png")
    up_world = drawing.draw_map(output, queries, exact_sdf, mapped.path_world, mapped.up_world)

    described = report.describe(mapped, config) | {"stream": name, "seed": seed} | scores
    described["up_world"] = up_world.tolist()
    described["total_s"] = time.perf_counter() - start
    report.write_json(output / "metrics.json", described)
    print(report.summarize(described))
    print(f"wrote {output}{os.sep} in {described['total_s']:.0f} s")
    if mapped.stopped is not None:
        raise mapped.stopped
    return described


def _score(queries: CompiledQueries, mapped: Mapped, truth: GroundTruth) -> dict[str, Any]:
    """Scores a map against exact distances where its frames saw."""
    sensor_world, last_frame = mapped.path_world[-1], mapped.last_frame
    scores = metrics.evaluate(queries.sdf_and_grad, truth, sensor_world, last_frame)
    scores |= metrics.evaluate_lower(queries.lower, truth, last_frame)
    bands = metrics.evaluate_bands(queries.sdf_and_grad, truth, sensor_world, last_frame)
    return {"scores": scores, "bands": bands}
