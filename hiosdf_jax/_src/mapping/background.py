"""Mapping in a background thread, while a controller plans on the newest snapshot."""

from __future__ import annotations

import atexit
import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from hiosdf_jax._src.mapping.pipeline import update
from hiosdf_jax._src.numerics.arrays import scalar
from hiosdf_jax._src.numerics.posed_cloud import as_floats, check_extras
from hiosdf_jax._src.state import Baked, Field, Flag, MapState, check_map, field_of

# What `update` raises for a bad frame: the others are faults of the machine or of this library.
# Warnings are raised where the user has made them errors.
_BAD_FRAME = (ValueError, TypeError, OverflowError, Warning)

# From here on float32, which holds a field's stamp, rounds by more than 0.06 s.
_MOST_SECONDS = 2.0**20

_CLOSING_S = 300.0  # an update that has to be compiled first takes a minute on a busy machine


class _Frame(NamedTuple):
    """What `put` hands over."""

    cloud: Any
    pose: Any
    stamp: float
    robot: tuple[Any, Any] | None
    noise: tuple[Any, Any] | None


class _Published(NamedTuple):
    """What controllers read; replaced as a whole, so that no reader sees parts of two."""

    field: Any
    stamp: float


class BackgroundMapper:
    """Updates a map in a background thread; `field` is always the newest finished map.

    One frame waits while another is fused. A newer frame replaces the waiting one, so that a slow
    machine maps fewer frames and not older ones. Use it in a `with` block, or call `close`. When
    the interpreter exits, a mapper that is still open finishes the frame that it is fusing, which
    takes longer where the first update is being compiled.

    Reading `field` never waits and never raises. A controller that reads nothing else should stop
    where `age(now)` is too large, or `failure` is not None.

    Attributes:
        field: The newest snapshot, or what `serve` has made of it, with the stamp of its frame.
        dropped: Number of frames that newer ones replaced.
        rejected: Number of frames that left `field` and its stamp as they were: `update` raised an
            exception or refused them, or `serve` raised one.
        rejection: The exception of the last of them, or None. For a frame that `update` refused it
            is a ValueError with the names of the flags.
        failure: The exception that ended the thread, or None. `put`, `wait` and `close` raise it.

    Example:
        >>> with hio.BackgroundMapper(state) as mapper:
        ...     mapper.put(cloud, pose, stamp)
        ...     if mapper.age(now) < 1.0:
        ...         command = controller(mapper.field, robot_state)
    """

    def __init__(
        self, state: MapState, *, serve: Callable[[Field], Field | Baked] | None = None
    ) -> None:
        """Starts the thread.

        Args:
            state: The map so far, from `init`, `load` or another mapper. Do not donate it later.
            serve: What to make of each snapshot, in the mapper's thread: for instance `hio.bake` of
                a window around the robot. It is called once before the thread starts.

        Raises:
            ValueError: `state` is not a map.
        """
        check_map(state)
        self.dropped = 0
        self.rejected = 0
        self.rejection: Exception | None = None
        self.failure: BaseException | None = None
        self._state = state
        self._serve = serve
        self._published = _Published(self._served(field_of(state)), -math.inf)
        self._waiting: _Frame | None = None
        self._busy = False
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="hiosdf_jax", daemon=True)
        self._thread.start()
        # A thread that runs compiled code while the interpreter ends would crash it.
        atexit.register(self._abandon)

    @property
    def field(self) -> Any:
        """The newest snapshot, or what `serve` has made of it."""
        return self._published.field

    def age(self, now: float) -> float:
        """Returns how long ago the newest fused frame was taken.

        Args:
            now: The time, s on the clock of the stamps.

        Returns:
            now - stamp, s, in double precision; inf before the first frame.

        Raises:
            ValueError: `now` is not a finite number.
        """
        return _seconds("now", now) - self._published.stamp

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
            stamp: Time of the frame, s on the caller's clock, counted from the start of the run:
                less than 2^20 s (12 days), since a field holds it as float32.
            robot: As for `update`: the robot's spheres at the time of the cloud.
            noise: As for `update`.

        Raises:
            ValueError: `stamp` is not a finite number, or too large for float32.
            RuntimeError: The mapper is closed, or its thread has failed.
        """
        seconds = _seconds("stamp", stamp, _MOST_SECONDS)
        with self._changed:
            self._check()
            if self._closed:
                raise RuntimeError("the BackgroundMapper is closed")
            self.dropped += self._waiting is not None
            self._waiting = _Frame(cloud, pose, seconds, robot, noise)
            self._changed.notify_all()

    def wait(self, timeout_s: float | None = None) -> MapState:
        """Waits until every frame is fused or dropped.

        Args:
            timeout_s: Longest time to wait, s; None waits as long as it takes.

        Returns:
            The map. It shares memory with `field`: do not donate it while `field` is in use.

        Raises:
            RuntimeError: The mapper's thread has failed.
            TimeoutError: Time is up.
        """
        with self._changed:
            done = self._changed.wait_for(
                lambda: (
                    self.failure is not None
                    or not self._thread.is_alive()
                    or (self._waiting is None and not self._busy)
                ),
                timeout_s,
            )
            self._check()
            if not done:
                raise TimeoutError(f"the BackgroundMapper still works after {timeout_s} s")
            return self._state

    def close(self, timeout_s: float = _CLOSING_S) -> MapState:
        """Fuses the waiting frame, ends the thread and returns the map.

        Args:
            timeout_s: Longest time to wait for the thread, s.

        Returns:
            The map, as `wait` returns it.

        Raises:
            RuntimeError: The mapper's thread has failed, or `serve` calls this.
            TimeoutError: Time is up. The thread ends after the frame that it fuses.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise TimeoutError(f"the BackgroundMapper still works after {timeout_s} s")
        atexit.unregister(self._abandon)
        self._check()
        return self._state

    def _abandon(self) -> None:
        """Ends the thread without fusing the waiting frame."""
        with self._changed:
            self._waiting = None
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_CLOSING_S)

    def __enter__(self) -> BackgroundMapper:
        """Returns the mapper itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes it; after an exception without fusing the waiting frame or raising another."""
        if kind is None:
            self.close()
        else:
            self._abandon()
            atexit.unregister(self._abandon)

    def _work(self) -> None:
        try:
            while (frame := self._next()) is not None:
                self._fuse(frame)
        except BaseException as failure:
            with self._changed:
                self.failure = failure
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
        if not fused:
            flags = Flag(int(state.report.update_flags))
            self._reject(ValueError(f"update refused the frame and raised the flags {flags}"))
            return
        stamp = scalar(frame.stamp)
        try:
            served = self._served(field_of(state).replace(stamp=stamp))
        except Exception as reason:  # whatever a function of the user's raises
            self._reject(reason)
            return
        self._published = _Published(served, frame.stamp)

    def _served(self, field: Field) -> Any:
        return field if self._serve is None else jax.block_until_ready(self._serve(field))

    def _reject(self, reason: Exception) -> None:
        self.rejected += 1
        self.rejection = reason

    def _check(self) -> None:
        if self.failure is not None:
            raise RuntimeError("the BackgroundMapper's thread has failed") from self.failure


def _seconds(name: str, value: Any, most: float = math.inf) -> float:
    """Converts a time to a float; raises a ValueError that names it if it cannot be one."""
    try:
        seconds = math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not (math.isfinite(seconds) and abs(seconds) < most):
        limit = f" below {most:.0f}, counted from the start of the run" if most < math.inf else ""
        raise ValueError(f"{name} is {value!r}, expected a finite number of seconds{limit}")
    return seconds
