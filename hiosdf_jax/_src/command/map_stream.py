"""A stream from end to end: mapped, scored, drawn and reported into a folder."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hiosdf_jax._src.command import report
from hiosdf_jax._src.command.live_map import LiveMap
from hiosdf_jax._src.command.map_frames import Mapped, fuse_frames, return_freed_memory
from hiosdf_jax._src.command.map_scores import scores_of
from hiosdf_jax._src.command.progress import Progress, SavedMap, save_map
from hiosdf_jax._src.command.stream_poses import TRAJECTORY, Tracker
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.mapping import checkpoint, lifecycle
from hiosdf_jax._src.output_files import replacing_together
from hiosdf_jax._src.scoring import held_out
from hiosdf_jax._src.state.pytrees import MapState, field_of
from hiosdf_jax._src.view import drawing
from hiosdf_jax._src.view.growing import Stage, save_growing

if TYPE_CHECKING:
    import trimesh

RESULTS = (*TRAJECTORY, "mesh.ply", "mesh.png", "slices.png", "growing.gif", "metrics.json")
_STAGES = 12  # of the growing map, that growing.gif shows
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
    resume_path: str | os.PathLike[str] | None = None,
    checkpoint_every: int | None = None,
    stop: Callable[[], object] = lambda: None,
    tracker: Tracker | None = None,
    live: LiveMap | None = None,
    draw_growing: bool = False,
) -> dict[str, Any]:
    """Maps a stream, scores and draws the map, and writes everything into a folder.

    The folder gets `metrics.json`, `slices.png`, `mesh.ply` and `mesh.png`, and `growing.gif` if it
    is to be drawn. They replace older ones together, after the last of them is drawn; a run that
    fails leaves older ones as they were. Without ground truth the map is scored on the returns of
    every tenth frame, which it is not given.

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
        resumed: The map to continue; of the same configuration and seed.
        resume_path: Its file, which this run may replace and, at its end, remove. A map of another
            run is renamed before one that is not finished takes its place.
        checkpoint_every: Number of updates after which the map is written again.
        stop: Is asked before each frame, and ends the mapping by returning something true.
        tracker: Refines the poses, and writes the trajectory. Such a run cannot be resumed: the
            file of the map has no poses.
        live: Shows the map while it grows.
        draw_growing: Draw `growing.gif`, too; with the default configuration it takes about a
            second for each of 12 pictures.

    Returns:
        The contents of `metrics.json`.

    Raises:
        BadFrameError: A frame is bad.
        StoppedError: `stop` has ended the mapping.
        NothingMappedError: No frame could be mapped.
        OtherStreamError: The map to resume was made from other frames.
        OSError: The folder or a file in it cannot be written.
    """
    output = Path(output)
    start = time.perf_counter()
    map_path = map_file(output, save_path)
    ours = set() if resume_path is None else {Path(resume_path).resolve()}  # this run's maps
    lost: list[OSError] = []

    def write(state: MapState, progress: Progress) -> Path:
        map_path.parent.mkdir(parents=True, exist_ok=True)
        place = map_path.resolve()
        if place not in ours and progress.next_frame < len(stream):
            _set_aside(place)
        if tracker is None:
            save_map(map_path, SavedMap(state, progress, seed, truth is None))
        else:
            checkpoint.save(map_path, state)
        ours.add(place)
        return map_path

    def keep(state: MapState, progress: Progress) -> None:
        try:
            write(state, progress)
            lost.clear()
        except OSError as error:  # no reason to lose the map in memory, or the scores and pictures
            lost[:] = [error]
            print(f"the map could not be written: {error}", file=sys.stderr)

    surfaces: list[tuple[int, trimesh.Trimesh]] = []
    due = set(np.rint(np.linspace(0, len(stream) - 1, _STAGES)).astype(int).tolist())
    fused = 0

    def watch(state: MapState, progress: Progress, cloud: np.ndarray, pose: np.ndarray) -> None:
        nonlocal fused
        fused += 1
        if draw_growing and progress.next_frame - 1 in due:
            surfaces.append((fused, extract_mesh(field_of(state), config.voxel_size)))
        if live is not None:
            live.watch(state, progress, cloud, pose)

    if live is not None:
        live.begin(write, stop)
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
        watch=watch,
    )
    if save_path is not None or mapped.stopped is not None:
        keep(mapped.state, mapped.progress)
    queries = CompiledQueries(lifecycle.snapshot(mapped.state))
    if live is not None:
        live.finish(queries.field)
    scores = {}
    if truth is not None:
        scores = _score(queries, mapped, truth)
    elif kept:
        returns_world = mapped.held_out_world
        scores["held_out"] = held_out.score_held_out(queries.sdf, queries.observed, returns_world)
    return_freed_memory()
    also = "growing.gif, " if draw_growing else ""
    print(f"drawing {also}slices.png, mesh.ply and mesh.png", flush=True)
    described: dict[str, Any] = {}
    with replacing_together(output, RESULTS) as folder:
        up_world = drawing.draw_map(folder, queries, exact_sdf, mapped.path_world, mapped.up_world)
        if surfaces:
            before = len(mapped.path_world) - fused  # positions of the run that this one continues
            stages = [Stage(mesh, mapped.path_world[: before + k]) for k, mesh in surfaces]
            save_growing(folder / "growing.gif", stages, up_world)
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
        if unfinished.resolve() in ours:
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


def _set_aside(path: Path) -> None:
    """Renames a map of another run, which a map that is not finished would replace."""
    if not path.is_file():
        return
    number = 1
    while (aside := path.with_stem(f"{path.stem}.{number}")).exists():
        number += 1
    path.rename(aside)
    print(f"{path} is of another run: kept as {aside.name}")


def _score(queries: CompiledQueries, mapped: Mapped, truth: GroundTruth) -> dict[str, Any]:
    """Scores a map against exact distances where its frames saw."""
    sensor_world, last_frame = mapped.path_world[-1], mapped.last_frame
    if not (truth.frame <= last_frame).any():  # the run ended early
        print("no exact distance belongs to the frames so far: the map is not scored")
        return {}
    return scores_of(queries, truth, sensor_world, last_frame)
