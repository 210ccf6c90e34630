"""A map that is watched in a browser while it grows, without slowing its growth much."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hiosdf_jax._src.command.map_frames import up_of_frame
from hiosdf_jax._src.command.progress import Progress
from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame
from hiosdf_jax._src.mapping.lifecycle import snapshot
from hiosdf_jax._src.state.pytrees import Field, MapState
from hiosdf_jax._src.view.live import Viewer

_SHARE = 0.08  # of the time of the mapping, that drawing may take
_SENSOR_SECONDS = 0.25  # between two drawings of the newest cloud alone


class Pace:
    """Says when to draw, so that drawing takes a bounded share of the time."""

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begins with a drawing that is due.

        Args:
            share: Share of the time that drawing may take.
            clock: The time, s.
        """
        self._share, self._clock = share, clock
        self._due = clock()
        self._is_first = True

    def is_due(self) -> bool:
        """Whether the next drawing may begin."""
        return self._clock() >= self._due

    def spend(self, draw: Callable[[], None]) -> None:
        """Draws, and notes how long that took; the first time it also compiles, which is free."""
        start = self._clock()
        draw()
        took = 0.0 if self._is_first else self._clock() - start
        self._is_first = False
        self._due = self._clock() + took * (1 - self._share) / self._share


class LiveMap:
    """Shows the map of a stream while it grows.

    Attributes:
        url: Where it is shown.
    """

    def __init__(
        self,
        stream: Stream,
        exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
        host: str,
        port: int,
        export_path: str | os.PathLike[str],
    ) -> None:
        """Starts to serve an empty view.

        Args:
            stream: The frames; up is computed from the first one.
            exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m, if known.
            host: Address to serve at.
            port: Port to serve at; the next free one is taken.
            export_path: The file that the button "export" writes.

        Raises:
            ValueError: Nothing can be served at this address.
            ModuleNotFoundError: viser is not installed.
        """
        self._viewer = Viewer(
            exact_sdf=exact_sdf,
            up_world=_up_of_stream(stream),
            host=host,
            port=port,
            on_save=self._save,
            export_path=export_path,
            can_pause=True,
        )
        self.url = self._viewer.url
        self._pace, self._sensor_pace = Pace(_SHARE), 0.0
        self._newest: tuple[MapState, Progress] | None = None
        self._frame: tuple[np.ndarray, np.ndarray] | None = None

    def begin(
        self, write: Callable[[MapState, Progress], Path], stop: Callable[[], object]
    ) -> None:
        """Takes what writes the map, and what ends a pause.

        Args:
            write: Writes a map, and returns the file.
            stop: Returns something true when the run is to end.
        """
        self._write, self._stop = write, stop

    def watch(
        self, state: MapState, progress: Progress, cloud: np.ndarray, pose: np.ndarray
    ) -> None:
        """Receives each fused frame of `fuse_frames`; returns when the mapping may continue.

        Args:
            state: The map.
            progress: How far it has come.
            cloud: (N, 3) m, sensor frame.
            pose: (4, 4) T_world_sensor.
        """
        self._newest, self._frame = (state, progress), (cloud, pose)
        if self._pace.is_due():
            self._pace.spend(lambda: self._viewer.show(snapshot(state), cloud, pose))
        elif time.perf_counter() >= self._sensor_pace:
            self._viewer.show_sensor(cloud, pose)
            self._sensor_pace = time.perf_counter() + _SENSOR_SECONDS
        while self._viewer.paused and not self._stop():
            time.sleep(0.05)

    def finish(self, field: Field) -> None:
        """Shows the finished map.

        Args:
            field: A snapshot of it.
        """
        if self._frame is not None:
            self._viewer.show(field, *self._frame)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Writes the view as one HTML file; see `Viewer.export`."""
        self._viewer.export(path)

    def close(self) -> None:
        """Ends the view."""
        self._viewer.close()

    def _save(self) -> str:
        if self._newest is None:
            raise ValueError("nothing is mapped yet")
        return os.fspath(self._write(*self._newest))


def _up_of_stream(stream: Stream) -> np.ndarray:
    """The axis of the world that is nearest to upward in the first frame, (3,)."""
    up = np.array([0.0, 0.0, 1.0])
    with contextlib.suppress(BadFrameError, IndexError):
        up = up_of_frame(*read_frame(stream, 0))
    axis = int(np.argmax(np.abs(up)))
    return np.sign(up[axis]) * np.eye(3)[axis]
