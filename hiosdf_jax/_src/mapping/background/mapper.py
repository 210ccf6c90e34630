"""Mapping in the background, while a controller plans on the newest snapshot."""

from __future__ import annotations

import atexit
import dataclasses
import math
import threading
from typing import Any, Literal

import numpy as np

from hiosdf_jax._src.mapping.background.child import Child, pack_serve
from hiosdf_jax._src.mapping.background.ending import end_with_interpreter
from hiosdf_jax._src.mapping.background.serving import (
    Frame,
    Fuser,
    RefusedError,
    Serve,
    checked,
    publish,
)
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import MapState

# From here on float32, which holds a field's stamp, rounds by more than 0.06 s.
_MOST_SECONDS = 2.0**20

_CLOSING_S = 300.0  # an update that has to be compiled first takes a minute on a busy machine
_NO_TIMES = str | bytes | bool | np.bool_  # although `float` takes them


@dataclasses.dataclass
class _Request:
    """Somebody waits for the map.

    Attributes:
        frames: Number of frames that the map has to hold, if they are not dropped or rejected.
        state: The map, as soon as it is there.
    """

    frames: int
    state: MapState | None = None


class BackgroundMapper:
    """Updates a map in the background; `field` is always the newest finished map.

    One frame waits while another is fused. A newer frame replaces the waiting one, so that a slow
    machine maps fewer frames and not older ones. Use it in a `with` block, or call `close`.

    By default it is a thread of this process. With `process=True` the map lies in a process of its
    own, on the CPU, to which the kernel gives the time that no other process wants: the choice for
    a controller with deadlines on few cores. Its first update compiles again, unless JAX's
    persistent cache has it (`JAX_COMPILATION_CACHE_DIR`), and `wait` and `close` bring the map
    back. If that process is killed, what it has mapped since the last `wait` is lost.

    When the interpreter exits, the frame that is being fused is given up: within seconds where the
    C library is glibc, even while XLA compiles. Elsewhere the exit waits for XLA. A process is
    killed, and also ends if its parent is killed.

    Reading `field` never waits and never raises. A controller that reads nothing else should stop
    where `age(now)` is too large, or `failure` is not None.

    Attributes:
        field: The newest snapshot, or the result of `serve` for it, with the stamp of its frame.
        serve: Function applied to each snapshot; its result becomes `field`. It may be replaced at
            any time, for instance to move a window with the robot. The next fused frame uses it.
        dropped: Number of frames that newer ones replaced.
        rejected: Number of frames that left `field` and its stamp as they were: `update` raised an
            exception or refused them, or `serve` raised one.
        rejection: The exception of the last of them, or None. For a frame that `update` refused it
            is a ValueError with the names of the flags.
        failure: The exception that ended the thread or the process, or None. `put`, `wait` and
            `close` raise it.

    Example:
        >>> with hio.BackgroundMapper(state) as mapper:
        ...     mapper.put(cloud, pose, stamp)
        ...     if mapper.age(now) < 1.0:
        ...         command = controller(mapper.field, robot_state)
    """

    def __init__(self, state: MapState, *, serve: Serve = None, process: bool = False) -> None:
        """Starts the thread, or the process.

        Args:
            state: The map so far, from `init`, `load` or another mapper. Do not donate it later.
            serve: Function applied to each snapshot, beside the controller; its result becomes
                `field`. For instance `hio.bake` of a window around the robot. It is called once
                before this returns. A process takes a function that it can import, or
                `functools.partial` of one.
            process: Whether to map in a process of its own.

        Raises:
            ValueError: `state` is not a map, or `serve` is not such a function.
        """
        check_map(state)
        if not isinstance(process, bool):
            raise ValueError(f"process is {process!r}, expected True or False")
        self.dropped = 0
        self.rejected = 0
        self.rejection: Exception | None = None
        self.failure: BaseException | None = None
        self._serve = self._checked_serve(serve, process)
        self._process = process
        self._published = publish(state, serve)
        self._waiting: Frame | None = None
        self._put = 0  # frames so far; the newest of them is the one that waits
        self._taken = 0  # the same, when the last one was taken to be fused
        self._handled = 0  # those that are fused, dropped or rejected
        self._requests: list[_Request] = []
        self._closed = False
        self._changed = threading.Condition()
        self._fuser = Child(state, self._notify) if process else Fuser(state)
        self._thread = threading.Thread(target=self._work, name="hiosdf_jax", daemon=True)
        self._thread.start()
        # A thread that runs compiled code while the interpreter ends would crash it.
        atexit.register(self._exit)

    @property
    def field(self) -> Any:
        """The newest snapshot, or what `serve` has made of it."""
        return self._published.field

    @property
    def serve(self) -> Serve:
        """Function applied to each snapshot; None for the snapshot itself."""
        return self._serve

    @serve.setter
    def serve(self, serve: Serve) -> None:
        self._serve = self._checked_serve(serve, self._process)

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
            RuntimeError: The mapper is closed, or has failed.
        """
        seconds = _seconds("stamp", stamp, _MOST_SECONDS)
        with self._changed:
            self._check()
            if self._closed:
                raise RuntimeError("the BackgroundMapper is closed")
            self.dropped += self._waiting is not None
            self._put += 1
            self._waiting = Frame(cloud, pose, seconds, robot, noise)
            self._changed.notify_all()

    def wait(self, timeout_s: float | None = None) -> MapState:
        """Waits until every frame that was put before is fused or dropped.

        Args:
            timeout_s: Longest time to wait, s; None waits as long as it takes.

        Returns:
            The map. It shares memory with `field`: do not donate it while `field` is in use.

        Raises:
            ValueError: `timeout_s` is not a finite number.
            RuntimeError: The mapper has failed.
            TimeoutError: Time is up.
        """
        timeout_s = _timeout(timeout_s)
        with self._changed:
            request = _Request(self._put)
            self._requests.append(request)
            self._changed.notify_all()
            try:
                self._changed.wait_for(lambda: request.state or self._has_ended(), timeout_s)
            finally:
                self._requests = [other for other in self._requests if other is not request]
            if request.state is not None:
                return request.state
            self._check()
            if not self._has_ended():
                raise TimeoutError(f"the BackgroundMapper still works after {timeout_s} s")
            return self._state()

    def close(self, timeout_s: float | None = _CLOSING_S) -> MapState:
        """Fuses the waiting frame, ends the thread and the process, and returns the map.

        Args:
            timeout_s: Longest time to wait for that, s; None waits as long as it takes.

        Returns:
            The map, as `wait` returns it.

        Raises:
            ValueError: `timeout_s` is not a finite number.
            RuntimeError: The mapper has failed, or `serve` calls this.
            TimeoutError: Time is up. The thread ends after the frame that it fuses.
        """
        timeout_s = _timeout(timeout_s)
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise TimeoutError(f"the BackgroundMapper still works after {timeout_s} s")
        atexit.unregister(self._exit)
        self._check()
        return self._state()

    def __enter__(self) -> BackgroundMapper:
        """Returns the mapper itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes it; after an exception without fusing the waiting frame or raising another."""
        if kind is None:
            self.close()
        else:
            self._abandon()
            self._thread.join(_CLOSING_S)
            self._fuser.stop()
            atexit.unregister(self._exit)

    def _exit(self) -> None:
        """Ends the thread as soon as possible, for the interpreter ends."""
        self._abandon()
        self._fuser.stop()
        end_with_interpreter(self._thread)

    def _abandon(self) -> None:
        """Makes the thread end without fusing the waiting frame."""
        with self._changed:
            self._waiting = None
            self._closed = True
            self._changed.notify_all()

    def _work(self) -> None:
        try:
            while (task := self._next()) != "end":
                if isinstance(task, Frame):
                    self._fuse(task)
                else:
                    self._fetch()
            self._fuser.fetch()
        except BaseException as failure:
            with self._changed:
                self.failure = failure
        self._fuser.stop()
        self._notify()

    def _next(self) -> Frame | Literal["fetch", "end"]:
        with self._changed:
            self._changed.wait_for(
                lambda: self._due() or self._waiting or self._closed or self._fuser.fault
            )
            if self._fuser.fault is not None and not self._closed:
                raise self._fuser.fault
            if self._due():  # before the next frame: a sensor may be faster than the map
                return "fetch"
            frame, self._waiting = self._waiting, None
            self._taken = self._put
            return "end" if frame is None else frame

    def _due(self) -> list[_Request]:
        return [request for request in self._requests if request.frames <= self._handled]

    def _fetch(self) -> None:
        state = self._fuser.fetch()
        with self._changed:
            for request in self._due():
                request.state = state
            self._requests = [request for request in self._requests if request.state is None]
            self._changed.notify_all()

    def _fuse(self, frame: Frame) -> None:
        try:
            self._published = self._fuser.fuse(checked(frame), self._serve)
        except RefusedError as refusal:
            self.rejected += 1
            self.rejection = refusal.reason
        self._handled = self._taken

    def _has_ended(self) -> bool:
        return self.failure is not None or not self._thread.is_alive()

    def _state(self) -> MapState:
        state = self._fuser.state
        if state is None:  # an exception has ended the process before it could give back the map
            raise RuntimeError("the BackgroundMapper was ended before it could return its map")
        return state

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _check(self) -> None:
        if self.failure is not None:
            where = "process" if self._process else "thread"
            raise RuntimeError(f"the BackgroundMapper's {where} has failed") from self.failure

    @staticmethod
    def _checked_serve(serve: Any, process: bool) -> Serve:
        if serve is not None and not callable(serve):
            raise ValueError(f"serve is {serve!r}, expected a function of a Field, or None")
        if process:
            pack_serve(serve)
        return serve


def _timeout(timeout_s: Any) -> float | None:
    """Checks how long to wait, s; None is forever, and so is more than threads can count."""
    if timeout_s is None:
        return None
    return min(_seconds("timeout_s", timeout_s), threading.TIMEOUT_MAX)


def _seconds(name: str, value: Any, most: float = math.inf) -> float:
    """Converts a time to a float; raises a ValueError that names it if it cannot be one."""
    try:
        seconds = math.nan if isinstance(value, _NO_TIMES) else float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not (math.isfinite(seconds) and abs(seconds) < most):
        limit = f" below {most:.0f}, counted from the start of the run" if most < math.inf else ""
        raise ValueError(f"{name} is {value!r}, expected a finite number of seconds{limit}")
    return seconds
