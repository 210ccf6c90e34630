"""Maps the frames of a stream one by one."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from hiosdf_jax._src.command.progress import FrameDigest, Progress, SavedMap
from hiosdf_jax._src.command.stream_poses import Tracker
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame
from hiosdf_jax._src.mapping import lifecycle, pipeline
from hiosdf_jax._src.scoring.held_out import draw_returns
from hiosdf_jax._src.state.pytrees import MapState


class NothingMappedError(Exception):
    """No frame of a stream could be mapped."""


class StoppedError(Exception):
    """The mapping was stopped; the message says why and where.

    Attributes:
        mapped: Whether the run has a map to show.
    """

    mapped = True


class OtherStreamError(ValueError):
    """The map to resume was made from other frames."""


@dataclasses.dataclass(frozen=True)
class Mapped:
    """The map of a stream, and how it was made.

    Attributes:
        state: The map after the last frame.
        path_world: (F, 3) m, the sensor's positions in the mapped frames.
        up_world: (3,) unit vector against gravity, estimated from the sensor's poses.
        update_seconds: (U,) s, of each update of this run until its result was ready.
        last_frame: Index of the last mapped frame.
        skipped: Number of bad frames that were skipped.
        stopped: What ended the mapping early, if anything: a bad frame or a signal.
        held_out_world: (M, 3) float32 m, returns of the frames that the map was not given.
        progress: How far the map has come in the stream.
    """

    state: MapState
    path_world: np.ndarray
    up_world: np.ndarray
    update_seconds: np.ndarray
    last_frame: int
    skipped: int
    stopped: BadFrameError | StoppedError | None
    held_out_world: np.ndarray
    progress: Progress


def fuse_frames(
    stream: Stream,
    config: Config,
    key: jax.Array,
    *,
    held_out: Sequence[int] = (),
    skip_bad_frames: bool = False,
    resumed: SavedMap | None = None,
    keep: Callable[[MapState, Progress], None] | None = None,
    keep_every: int | None = None,
    stop: Callable[[], object] = lambda: None,
    tracker: Tracker | None = None,
    watch: Callable[[MapState, Progress, np.ndarray, np.ndarray], None] | None = None,
) -> Mapped:
    """Fuses the frames of a stream into a map, one by one, with a progress bar.

    A run that continues a map reads the frames before once more, to recognize the stream and to
    know the sensor's path, but does not fuse them again.

    Args:
        stream: The frames.
        config: The map's configuration.
        key: Source of the map's randomness; a resumed map has its own.
        held_out: Indices of frames that the map is not given; the result has returns of theirs.
        skip_bad_frames: Report bad frames on stderr and continue. By default the first bad frame
            ends the mapping.
        resumed: The map to continue.
        keep: Is given the map so far, and how far it has come.
        keep_every: Number of updates after which `keep` is called again.
        stop: Is asked before each frame. The mapping ends if it returns something true, whose `str`
            is the reason.
        tracker: Refines the poses. By default they are used as the stream gives them.
        watch: Is given the map after each frame, how far it has come, and the frame: its cloud
            (N, 3) m, sensor frame, and its pose (4, 4) T_world_sensor.

    Returns:
        The map and how it was made.

    Raises:
        BadFrameError: A frame is bad and nothing was mapped before it.
        NothingMappedError: No frame could be mapped.
        OtherStreamError: The map to resume was made from other frames.
        StoppedError: The mapping was to end before anything was mapped.
    """
    from tqdm import tqdm

    if resumed is None:
        state, before = lifecycle.init(config, key), Progress()
    else:
        state, before = resumed.state, resumed.progress
    first, points_used, points_outside = (
        before.next_frame,
        before.points_used,
        before.points_outside,
    )
    digest = FrameDigest()
    seconds, path_world, ups_world = [], [], []
    kept_world, kept_rng = [np.empty((0, 3), np.float32)], np.random.default_rng(0)
    skipped = last_frame = 0
    stopped = None

    def progress(next_frame: int) -> Progress:
        return Progress(next_frame, digest.text(), points_used, points_outside)

    def check_frames_before(next_frame: int) -> None:
        if next_frame == first > 0 and digest.text() != before.digest:
            raise OtherStreamError(
                f"the map was made from other frames than the first {first} of this stream"
            )

    if first > len(stream):
        raise OtherStreamError(
            f"the map was made from {first} frames, but the stream has only {len(stream)}"
        )
    bar = tqdm(range(len(stream)), desc="mapping", unit="frame")
    for i in bar:
        check_frames_before(i)
        if reason := stop():
            stopped = StoppedError(f"{reason} after {i} of {len(stream)} frames")
            break
        try:
            cloud, pose = read_frame(stream, i)
        except BadFrameError as error:
            if not skip_bad_frames:
                stopped = error
                break
            digest.add(None, None)
            skipped += 1
            tqdm.write(str(error), file=sys.stderr)
            continue
        digest.add(cloud, pose)
        if i in held_out:
            if tracker is not None:
                pose = tracker.locate(state, cloud, pose, i)
            kept_world.append(draw_returns(cloud, pose, config, len(held_out), kept_rng))
            continue
        last_frame = i
        updates = int(state.updates)
        start = time.perf_counter()
        if i >= first:
            if not seconds:
                bar.set_postfix_str("compiling")
            if tracker is not None:
                state, pose = tracker.fuse(state, cloud, pose, i)
            else:
                state = pipeline.update(state, cloud, pose)
            jax.block_until_ready(state)
        path_world.append(pose[:3, 3])
        ups_world.append(up_of_frame(cloud, pose))
        if i < first:
            continue
        seconds.append(time.perf_counter() - start)
        if len(seconds) == 1:
            return_freed_memory()
            bar.unpause()  # the rate is that of the other frames
        if int(state.updates) > updates:  # a refused cloud leaves the numbers of the one before it
            points_used += int(state.report.points_used)
            points_outside += int(state.report.points_outside)
        if keep is not None and keep_every and len(seconds) % keep_every == 0:
            keep(state, progress(i + 1))
        if watch is not None:
            watch(state, progress(i + 1), cloud, pose)
        if i % 5 == 0:
            loss_cm = 100 * float(state.report.sdf_loss)
            bar.set_postfix_str(
                f"loss {loss_cm:.1f} cm, {int(state.report.points_used)} points", refresh=False
            )
    else:
        i = len(stream)
        check_frames_before(i)
    bar.close()
    if not path_world or i < first:  # what was read again is no result of this run
        if isinstance(stopped, StoppedError):
            stopped.mapped = False
        raise stopped or NothingMappedError(
            f"none of the {len(stream) - len(held_out)} frames could be mapped, "
            "expected at least one"
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
        progress=progress(i),
    )


def return_freed_memory() -> None:
    """Returns memory that compiling has freed to the system; glibc would keep 0.5 GB of it."""
    with contextlib.suppress(OSError, AttributeError):  # another libc
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def up_of_frame(cloud: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Guesses the direction against gravity from a sensor that is carried upright.

    A camera sees only what lies in front of it, along z, and its y points down. A LiDAR sees all
    around, and its z points up.

    Args:
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.

    Returns:
        (3,) unit vector, world frame.
    """
    heights = cloud[np.isfinite(cloud).all(axis=-1), 2]
    return -pose[:3, 1] if (heights > 0).all() else pose[:3, 2]
