"""Maps the frames of a stream one by one."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from hiosdf_jax._src.command.progress import Progress, SavedMap
from hiosdf_jax._src.command.stream_frames import StoppedError, StreamFrames
from hiosdf_jax._src.command.stream_poses import Tracker
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import BadFrameError, Stream
from hiosdf_jax._src.mapping import lifecycle, pipeline
from hiosdf_jax._src.scoring.held_out import draw_returns
from hiosdf_jax._src.state.pytrees import MapState


class NothingMappedError(Exception):
    """No frame of a stream could be mapped."""


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
    if resumed is None:
        state, before = lifecycle.init(config, key), Progress()
    else:
        state, before = resumed.state, resumed.progress
    frames = StreamFrames(stream, before, skip_bad_frames=skip_bad_frames, stop=stop)
    points_used, points_outside = before.points_used, before.points_outside
    seconds, path_world, ups_world = [], [], []
    returns_world, rng = [np.empty((0, 3), np.float32)], np.random.default_rng(0)
    last_frame = 0

    def progress() -> Progress:
        return Progress(frames.next_frame, frames.digest(), points_used, points_outside)

    with frames.bar:
        while frame := frames.read_next():
            i, cloud, pose = frame
            if i in held_out:
                if tracker is not None:
                    pose = tracker.locate(state, cloud, pose, i)
                returns_world.append(draw_returns(cloud, pose, config, len(held_out), rng))
                continue
            last_frame = i
            is_new = i >= before.next_frame
            if is_new:
                if not seconds:
                    frames.bar.set_postfix_str("compiling")
                updates, start = int(state.updates), time.perf_counter()
                state, pose = _fuse(state, cloud, pose, i, tracker)
                seconds.append(time.perf_counter() - start)
                if int(state.updates) > updates:  # a refused cloud leaves the last one's numbers
                    points_used += int(state.report.points_used)
                    points_outside += int(state.report.points_outside)
            path_world.append(pose[:3, 3])
            ups_world.append(up_of_frame(cloud, pose))
            if not is_new:
                continue
            if len(seconds) == 1:
                return_freed_memory()
                frames.bar.unpause()  # the rate is that of the other frames
            if keep is not None and keep_every and len(seconds) % keep_every == 0:
                keep(state, progress())
            if watch is not None:
                watch(state, progress(), cloud, pose)
            if i % 5 == 0:
                loss_cm = 100 * float(state.report.sdf_loss)
                text = f"loss {loss_cm:.1f} cm, {int(state.report.points_used)} points"
                frames.bar.set_postfix_str(text, refresh=False)
    if not path_world or frames.next_frame < before.next_frame:  # what was read again is no result
        if isinstance(frames.stopped, StoppedError):
            frames.stopped.mapped = False
        raise frames.stopped or NothingMappedError(
            f"none of the {len(stream) - len(held_out)} frames could be mapped, "
            "expected at least one"
        )
    return Mapped(
        state=state,
        path_world=np.asarray(path_world, float),
        up_world=_mean_direction(ups_world),
        update_seconds=np.asarray(seconds),
        last_frame=last_frame,
        skipped=frames.skipped,
        stopped=frames.stopped,
        held_out_world=np.concatenate(returns_world),
        progress=progress(),
    )


def _fuse(
    state: MapState, cloud: np.ndarray, pose: np.ndarray, number: int, tracker: Tracker | None
) -> tuple[MapState, np.ndarray]:
    """Fuses a frame, and waits for the map; returns it and the pose that was used."""
    if tracker is not None:
        state, pose = tracker.fuse(state, cloud, pose, number)
    else:
        state = pipeline.update(state, cloud, pose)
    return jax.block_until_ready(state), pose


def _mean_direction(directions: Sequence[np.ndarray]) -> np.ndarray:
    """Averages unit vectors; z if they contradict each other."""
    mean = np.mean(directions, axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 0.1 else np.array([0.0, 0.0, 1.0])


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
