"""Reads the frames of a stream in order, with a progress bar, until there is a reason to stop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.command.progress import FrameDigest, Progress
from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame


class StoppedError(Exception):
    """The mapping was stopped; the message says why and where.

    Attributes:
        mapped: Whether the run has a map to show.
    """

    mapped = True


class OtherStreamError(ValueError):
    """The map to resume was made from other frames."""


class StreamFrame(NamedTuple):
    """A frame that can be used.

    Attributes:
        index: Its index in the stream.
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.
    """

    index: int
    cloud: np.ndarray
    pose: np.ndarray


class StreamFrames:
    """The frames of a stream, which are read in order.

    Attributes:
        bar: The progress bar.
        next_frame: Index of the first frame that has not been read.
        skipped: Number of bad frames that were skipped.
        stopped: What ended the reading early, if anything: a bad frame or a signal.
    """

    def __init__(
        self,
        stream: Stream,
        before: Progress,
        *,
        skip_bad_frames: bool,
        stop: Callable[[], object],
    ) -> None:
        """Begins with the first frame.

        Args:
            stream: The frames.
            before: How far the map to resume has come. Its frames are read again, and must be
                those that it was made from.
            skip_bad_frames: Report bad frames on stderr and continue. Otherwise the first bad
                frame ends the reading.
            stop: Is asked before each frame. The reading ends if it returns something true, whose
                `str` is the reason.

        Raises:
            OtherStreamError: The map to resume was made from more frames than the stream has.
        """
        from tqdm import tqdm

        if before.next_frame > len(stream):
            raise OtherStreamError(
                f"the map was made from {before.next_frame} frames, but the stream has only "
                f"{len(stream)}"
            )
        self._stream, self._before, self._stop = stream, before, stop
        self._skip_bad_frames = skip_bad_frames
        self._digest = FrameDigest()
        self.bar = tqdm(total=len(stream), desc="mapping", unit="frame")
        self.next_frame = self.skipped = 0
        self.stopped: BadFrameError | StoppedError | None = None

    def digest(self) -> str:
        """The digest of the frames so far."""
        return self._digest.text()

    def read_next(self) -> StreamFrame | None:
        """Reads the next frame that can be used.

        Returns:
            The frame. None at the end of the stream, or if `stopped` says why there are no more.

        Raises:
            OtherStreamError: The map to resume was made from other frames.
        """
        while True:
            self.bar.update(self.next_frame - self.bar.n)
            self._check_frames_before()
            i, count = self.next_frame, len(self._stream)
            if i == count:
                return None
            if reason := self._stop():
                self.stopped = StoppedError(f"{reason} after {i} of {count} frames")
                return None
            try:
                cloud, pose = read_frame(self._stream, i)
            except BadFrameError as error:
                if not self._skip_bad_frames:
                    self.stopped = error
                    return None
                self._digest.add(None, None)
                self.next_frame += 1
                self.skipped += 1
                self.bar.write(str(error), file=sys.stderr)
                continue
            self._digest.add(cloud, pose)
            self.next_frame += 1
            return StreamFrame(i, cloud, pose)

    def _check_frames_before(self) -> None:
        """Compares the frames of the map to resume, once they are all read."""
        first = self._before.next_frame
        if first > 0 and self.next_frame == first and self.digest() != self._before.digest:
            raise OtherStreamError(
                f"the map was made from other frames than the first {first} of this stream"
            )
