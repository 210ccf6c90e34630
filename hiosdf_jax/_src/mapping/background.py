"""Mapping in a background thread, while a controller plans on the newest snapshot."""

from __future__ import annotations

import atexit
import math
import threading
from typing import Any, NamedTuple

import jax
import numpy as np

from hiosdf_jax._src.mapping.pipeline import update
from hiosdf_jax._src.numerics.posed_cloud import as_floats, check_extras
from hiosdf_jax._src.state import Field, Flag, MapState, check_map, field_of

# What `update` raises for a bad frame: the others are faults of the machine or of this library.
# Warnings are raised where the user has made them errors.
_BAD_FRAME = (ValueError, TypeError, OverflowError, Warning)


class _Frame(NamedTuple):
    """What `put` hands over."""

    cloud: Any
    pose: Any
    stamp: float
    robot: tuple[Any, Any] | None
    noise: tuple[Any, Any] | None


class BackgroundMapper:
    """Updates a map in a background thread; `field` is always the newest finished map.

    One frame waits while another is fused. A newer frame replaces the waiting one, so that a slow
    machine maps fewer frames and not older ones. Use it in a `with` block, or call `close`. When
    the interpreter exits, a mapper that is still open finishes the frame that it is fusing.

    Attributes:
        field: The newest snapshot, with the stamp of its frame. Reading it never waits.
        dropped: Number of frames that newer ones replaced.
        rejected: Number of frames that left the map as it was: `update` raised an exception or
            refused them. They leave `field` and its stamp as they were, too.
        rejection: The exception of the last of them, or None. For a frame that `update` refused it
            is a ValueError with the names of the flags.

    Example:
        >>> with hio.BackgroundMapper(state) as mapper:
        ...     mapper.put(cloud, pose, stamp)
        ...     command = controller(mapper.field, robot_state)
    """

    def __init__(self, state: MapState) -> None:
        """Starts the thread.

        Args:
            state: The map so far, from `init`, `load` or another mapper. Do not donate it later.

        Raises:
            ValueError: `state` is not a map.
        """
        check_map(state)
        self.field: Field = field_of(state)
        self.dropped = 0
        self.rejected = 0
        self.rejection: Exception | None = None
        self._state = state
        self._waiting: _Frame | None = None
        self._busy = False
        self._closed = False
        self._failure: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="hiosdf_jax", daemon=True)
        self._thread.start()
        # A thread that runs compiled code while the interpreter ends would crash it.
        atexit.register(self._abandon)

    def put(
        self,
        cloud: Any,
        pose: Any,
        stamp: float = 0.0,
        *,
        robot: tuple[Any, Any] | None = None,
        noise: tuple[Any, Any] | None = None,
    ) -> None:
        """Hands a frame over and returns at once.

        Args:
            cloud: As for `update`. Do not change this or any other array afterward.
            pose: As for `update`.
            stamp: Time of the frame, s on the caller's clock, counted from the start of the run.
            robot: As for `update`: the robot's spheres at the time of the cloud.
            noise: As for `update`.

        Raises:
            ValueError: `stamp` is not a finite number.
            RuntimeError: The mapper is closed, or its thread has failed.
        """
        try:
            with np.errstate(over="ignore"):  # becomes inf, which is refused
                seconds = float(np.float32(stamp))
        except (*_BAD_FRAME, FloatingPointError):
            seconds = math.nan
        if not math.isfinite(seconds):
            raise ValueError(f"stamp is {stamp!r}, expected a finite number of seconds")
        with self._changed:
            self._check()
            if self._closed:
                raise RuntimeError("the BackgroundMapper is closed")
            self.dropped += self._waiting is not None
            self._waiting = _Frame(cloud, pose, seconds, robot, noise)
            self._changed.notify_all()

    def wait(self) -> MapState:
        """Waits until every frame is fused or dropped.

        Returns:
            The map. It shares memory with `field`: do not donate it while `field` is in use.

        Raises:
            RuntimeError: The mapper's thread has failed.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._failure is not None or (self._waiting is None and not self._busy)
            )
            self._check()
            return self._state

    def close(self) -> MapState:
        """Fuses the waiting frame, ends the thread and returns the map.

        Returns:
            The map, as `wait` returns it.

        Raises:
            RuntimeError: The mapper's thread has failed.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()
        atexit.unregister(self._abandon)
        self._check()
        return self._state

    def _abandon(self) -> None:
        """Ends the thread without fusing the waiting frame."""
        with self._changed:
            self._waiting = None
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> BackgroundMapper:
        """Returns the mapper itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes it."""
        self.close()

    def _work(self) -> None:
        try:
            while (frame := self._next()) is not None:
                self._fuse(frame)
        except BaseException as failure:
            with self._changed:
                self._failure = failure
                self._changed.notify_all()

    def _next(self) -> _Frame | None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._waiting is not None or self._closed)
            frame, self._waiting = self._waiting, None
            self._busy = frame is not None
            return frame

    def _fuse(self, frame: _Frame) -> None:
        try:
            cloud, pose = as_floats("cloud", frame.cloud), as_floats("pose", frame.pose)
            robot, noise = check_extras(frame.robot, frame.noise)
        except Exception as reason:  # whatever an object of the user's raises
            self._reject(reason)
            return
        try:
            # Finished before it is published, so that no reader waits for the device. The old state
            # is not donated, so that the old field stays valid without a copy.
            state = jax.block_until_ready(
                update(self._state, cloud, pose, robot=robot, noise=noise)
            )
        except _BAD_FRAME as reason:
            self._reject(reason)
            return
        fused = int(state.updates) > int(self._state.updates)
        self._state = state
        if fused:
            self.field = field_of(state).replace(stamp=jax.numpy.float32(frame.stamp))
        else:
            flags = Flag(int(state.report.update_flags))
            self._reject(ValueError(f"update refused the frame and raised the flags {flags}"))

    def _reject(self, reason: Exception) -> None:
        self.rejected += 1
        self.rejection = reason

    def _check(self) -> None:
        if self._failure is not None:
            raise RuntimeError("the BackgroundMapper's thread has failed") from self._failure
