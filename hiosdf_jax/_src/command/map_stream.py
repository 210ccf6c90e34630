"""A stream from end to end: mapped, scored, drawn and reported into a folder."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.command import report
from hiosdf_jax._src.command.map_frames import Mapped, fuse_frames, return_freed_memory
from hiosdf_jax._src.command.progress import Progress, SavedMap, save_map
from hiosdf_jax._src.command.tracker import TRAJECTORY, Tracker
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.mapping import checkpoint, pipeline
from hiosdf_jax._src.output_files import replacing_together
from hiosdf_jax._src.scoring import held_out, metrics
from hiosdf_jax._src.state import MapState
from hiosdf_jax._src.view import drawing

RESULTS = (*TRAJECTORY, "mesh.ply", "mesh.png", "slices.png", "metrics.json")
UNFINISHED = "checkpoint.npz"  # the map of a run that has not come to its end


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
    resumed: SavedMap | None = None,
    checkpoint_every: int | None = None,
    stop: Callable[[], object] = lambda: None,
    tracker: Tracker | None = None,
) -> dict[str, Any]:
    """Maps a stream, scores and draws the map, and writes everything into a folder.

    The folder gets `metrics.json`, `slices.png`, `mesh.ply` and `mesh.png`. They take the places of
    older ones together, after the last of them is drawn; a run that fails leaves older ones as they
    were. Without ground truth the map is scored on the returns of every tenth frame, which it is
    not given.

    A bad frame or a signal ends the mapping. The map of the frames before it is valid, so it is
    still saved, scored, drawn and written before the error is raised.

    Args:
        stream: The frames.
        config: The map's configuration.
        output: The folder; created if missing.
        name: Name of the stream in `metrics.json`.
        seed: Seed of the map's randomness.
        truth: Exact distances to score against.
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m; drawn beside the
            map.
        save_path: Where to write the map itself, see `hiosdf_jax.load`. By default it is written
            to `checkpoint.npz` in the folder, and only while the run has not come to its end.
        skip_bad_frames: Skip bad frames and count them.
        resumed: The map to go on with; of the same configuration and seed.
        checkpoint_every: Number of updates after which the map is written again.
        stop: Is asked before each frame, and ends the mapping by returning something true.
        tracker: Refines the poses, and writes the trajectory. Such a run cannot be resumed: the
            file of the map has no poses.

    Returns:
        The contents of `metrics.json`.

    Raises:
        BadFrameError: A frame is bad.
        StoppedError: `stop` has ended the mapping.
        NothingMappedError: No frame could be mapped.
        OtherStreamError: The map to go on with was made from other frames.
        OSError: The folder or a file in it cannot be written.
    """
    output = Path(output)
    start = time.perf_counter()
    map_path = map_file(output, save_path)
    lost: list[OSError] = []

    def keep(state: MapState, progress: Progress) -> None:
        try:
            map_path.parent.mkdir(parents=True, exist_ok=True)
            if tracker is None:
                save_map(map_path, SavedMap(state, progress, seed, truth is None))
            else:
                checkpoint.save(map_path, state)
            lost.clear()
        except OSError as error:  # no reason to lose the map in memory, or the scores and pictures
            lost[:] = [error]
            print(f"the map could not be written: {error}", file=sys.stderr)

    kept = held_out.held_out_frames(len(stream)) if truth is None else range(0)
    mapped = fuse_frames(
        stream,
        config,
        jax.random.key(seed),
        held_out=kept,
        skip_bad_frames=skip_bad_frames,
        resumed=resumed,
        keep=keep,
        keep_every=checkpoint_every,
        stop=stop,
        tracker=tracker,
    )
    if save_path is not None or mapped.stopped is not None:
        keep(mapped.state, mapped.progress)
    queries = CompiledQueries(pipeline.snapshot(mapped.state))
    scores = {}
    if truth is not None:
        scores = _score(queries, mapped, truth)
    elif kept:
        returns_world = mapped.held_out_world
        scores["held_out"] = held_out.score_held_out(queries.sdf, queries.observed, returns_world)
    return_freed_memory()
    print("drawing slices.png, mesh.ply and mesh.png", flush=True)
    described: dict[str, Any] = {}
    with replacing_together(output, RESULTS) as folder:
        up_world = drawing.draw_map(folder, queries, exact_sdf, mapped.path_world, mapped.up_world)
        described = report.describe(mapped, config) | {"stream": name, "seed": seed} | scores
        described["up_world"] = up_world.tolist()
        if tracker is not None:
            described |= tracker.counts()
            tracker.write(folder, up_world)
        described["total_s"] = time.perf_counter() - start
        report.write_json(folder / "metrics.json", described)
    print(report.summarize(described))
    print(f"wrote {output}{os.sep} in {described['total_s']:.0f} s")
    if lost:
        raise lost[0]
    if mapped.stopped is not None:
        raise mapped.stopped
    unfinished = output / UNFINISHED
    if save_path is None or map_path.resolve() != unfinished.resolve():
        this_run_wrote_it = resumed is not None or (checkpoint_every and save_path is None)
        if this_run_wrote_it:
            unfinished.unlink(missing_ok=True)
        elif unfinished.exists():
            print(f"{unfinished} is of an earlier run that was stopped")
    return described


def map_file(output: Path, save_path: str | os.PathLike[str] | None) -> Path:
    """Where a run writes its map while it has not come to its end.

    Args:
        output: The folder of the results.
        save_path: Where the map of a run that comes to its end is written, if anywhere.

    Returns:
        The file.
    """
    return output / UNFINISHED if save_path is None else Path(save_path)


def _score(queries: CompiledQueries, mapped: Mapped, truth: GroundTruth) -> dict[str, Any]:
    """Scores a map against exact distances where its frames saw."""
    sensor_world, last_frame = mapped.path_world[-1], mapped.last_frame
    if not (truth.frame <= last_frame).any():  # the run ended early
        print("no exact distance belongs to the frames so far: the map is not scored")
        return {}
    scores = metrics.evaluate(queries.sdf_and_grad, truth, sensor_world, last_frame)
    scores |= metrics.evaluate_lower(queries.lower, truth, last_frame)
    bands = metrics.evaluate_bands(queries.sdf_and_grad, truth, sensor_world, last_frame)
    return {"scores": scores, "bands": bands}
