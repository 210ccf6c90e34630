"""A stream from end to end: mapped, scored, drawn and reported into a folder."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hiosdf_jax._src.command import report
from hiosdf_jax._src.command.live_map import LiveMap
from hiosdf_jax._src.command.map_file import MapFile
from hiosdf_jax._src.command.map_frames import Mapped, fuse_frames, return_freed_memory
from hiosdf_jax._src.command.map_scores import scores_of
from hiosdf_jax._src.command.progress import Progress, SavedMap
from hiosdf_jax._src.command.stream_poses import TRAJECTORY, Tracker
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.mapping import lifecycle
from hiosdf_jax._src.output_files import replacing_together
from hiosdf_jax._src.scoring.held_out import held_out_frames, score_held_out
from hiosdf_jax._src.state.pytrees import MapState, field_of
from hiosdf_jax._src.view import drawing
from hiosdf_jax._src.view.growing import MapSoFar, save_growing

if TYPE_CHECKING:
    import trimesh

RESULTS = (*TRAJECTORY, "mesh.ply", "mesh.png", "slices.png", "growing.gif", "metrics.json")
_PICTURES = 12  # of growing.gif


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
            to `checkpoint.npz` in the folder, and only until the run has finished.
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
    map_file = MapFile(
        output,
        save_path,
        resume_path=resume_path,
        frames=len(stream),
        seed=seed,
        held_out=truth is None,
        with_progress=tracker is None,
    )
    growing = _Growing(len(stream), config.voxel_size) if draw_growing else None
    held_out = held_out_frames(len(stream)) if truth is None else range(0)

    def watch(state: MapState, progress: Progress, cloud: np.ndarray, pose: np.ndarray) -> None:
        if growing is not None:
            growing.watch(state, progress)
        if live is not None:
            live.watch(state, progress, cloud, pose)

    if live is not None:
        live.begin(map_file.write, stop)
    mapped = fuse_frames(
        stream,
        config,
        jax.random.key(seed),
        held_out=held_out,
        skip_bad_frames=skip_bad_frames,
        resumed=resumed,
        keep=map_file.keep,
        keep_every=checkpoint_every,
        stop=stop,
        tracker=tracker,
        watch=watch,
    )
    if save_path is not None or mapped.stopped is not None:
        map_file.keep(mapped.state, mapped.progress)
    queries = CompiledQueries(lifecycle.snapshot(mapped.state))
    if live is not None:
        live.finish(queries.field)
    described = report.describe(mapped, config) | {"stream": name, "seed": seed}
    if truth is not None:
        described |= _score(queries, mapped, truth)
    elif held_out:
        returns_world = mapped.held_out_world
        score = score_held_out(queries.sdf, queries.observed, returns_world)
        described["held_out"] = score
    return_freed_memory()
    also = "growing.gif, " if growing is not None else ""
    print(f"drawing {also}slices.png, mesh.ply and mesh.png", flush=True)
    with replacing_together(output, RESULTS) as folder:
        up_world = drawing.draw_map(folder, queries, exact_sdf, mapped.path_world, mapped.up_world)
        if growing is not None:
            growing.save(folder / "growing.gif", mapped.path_world, up_world)
        described["up_world"] = up_world.tolist()
        if tracker is not None:
            described |= tracker.counts()
            tracker.write(folder, up_world)
        described["total_s"] = time.perf_counter() - start
        report.write_json(folder / "metrics.json", described)
    print(report.summarize(described))
    print(f"wrote {output}{os.sep} in {described['total_s']:.0f} s")
    if error := map_file.error or mapped.stopped:
        raise error
    map_file.remove_unfinished()
    return described


class _Growing:
    """Meshes of the growing map, for `growing.gif`."""

    def __init__(self, frames: int, resolution: float) -> None:
        self._due = set(np.rint(np.linspace(0, frames - 1, _PICTURES)).astype(int).tolist())
        self._resolution = resolution
        self._fused = 0
        self._meshes: list[tuple[int, trimesh.Trimesh]] = []

    def watch(self, state: MapState, progress: Progress) -> None:
        self._fused += 1
        if progress.next_frame - 1 in self._due:
            mesh = extract_mesh(field_of(state), self._resolution)
            self._meshes.append((self._fused, mesh))

    def save(self, path: Path, path_world: np.ndarray, up_world: np.ndarray) -> None:
        if self._meshes:
            before = len(path_world) - self._fused  # positions of the run that this one continues
            maps = [MapSoFar(mesh, path_world[: before + k]) for k, mesh in self._meshes]
            save_growing(path, maps, up_world)


def _score(queries: CompiledQueries, mapped: Mapped, truth: GroundTruth) -> dict[str, Any]:
    """Scores a map against exact distances where its frames saw."""
    sensor_world, last_frame = mapped.path_world[-1], mapped.last_frame
    if not (truth.frame <= last_frame).any():  # the run ended early
        print("no exact distance belongs to the frames so far: the map is not scored")
        return {}
    return scores_of(queries, truth, sensor_world, last_frame)
