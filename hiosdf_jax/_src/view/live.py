"""A live view of a map in a browser, served on this machine alone by default."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np

from hiosdf_jax._src.mapping.checkpoint import save
from hiosdf_jax._src.numerics.intake import as_real
from hiosdf_jax._src.planning.clearance import checked_spheres
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState
from hiosdf_jax._src.view import colors, moments, page, scene, stage, web_server

_UP = (0.0, 0.0, 1.0)
_AXES = ("x", "y", "z")


def view(
    field: MapState | Field,
    *,
    spheres: tuple[Any, Any] | None = None,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None = None,
    up_world: Any = _UP,
    host: str = web_server.LOOPBACK,
    port: int = web_server.PORT,
) -> Viewer:
    """Shows a map in a browser, in three dimensions.

    It returns at once; the view lives as long as the process, or until `close`. In a notebook the
    result is the view itself. It needs the extra `view`.

    Args:
        field: A map, or a snapshot of one. With a map, a button saves it to `map.npz`.
        spheres: Centers (K, 3) m, world frame, and radii (K,) m of a robot's spheres, colored by
            their clearance; unseen space is an obstacle.
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m; the surface can
            then be colored by its error.
        up_world: (3,) direction against gravity, of any length.
        host: Address to serve at. By default only this machine can connect. Others can with
            "0.0.0.0", and there is no password.
        port: Port to serve at; the next free one is taken.

    Returns:
        The view, with its address in `url`.

    Raises:
        ValueError: An argument has a wrong type, shape or value.
        ModuleNotFoundError: viser is not installed.

    Example:
        >>> viewer = hio.view(field)
        >>> viewer.show(hio.snapshot(state), cloud, pose)  # later
        >>> viewer.export("scene.html")
    """
    shown = as_live_field(field)
    keep = None if isinstance(field, Field) else functools.partial(_save_to, "map.npz", field)
    viewer = Viewer(exact_sdf=exact_sdf, up_world=up_world, host=host, port=port, on_save=keep)
    if spheres is not None:
        viewer.show_robot(*spheres)
    viewer.show(shown)
    return viewer


def _save_to(path: str, state: MapState) -> str:
    save(path, state)
    return path


class Viewer:
    """A view of a map in a browser; made by `view`.

    All methods may be called from any thread.

    Attributes:
        url: Where it is served.
        paused: Whether the button "pause" is pressed; who maps decides what that means.
    """

    def __init__(
        self,
        *,
        exact_sdf: Callable[[np.ndarray], np.ndarray] | None = None,
        up_world: Any = _UP,
        host: str = web_server.LOOPBACK,
        port: int = web_server.PORT,
        on_save: Callable[[], str] | None = None,
        export_path: str | os.PathLike[str] = "scene.html",
        can_pause: bool = False,
    ) -> None:
        """Starts to serve an empty view; see `view`.

        Args:
            exact_sdf: As for `view`.
            up_world: As for `view`.
            host: As for `view`.
            port: As for `view`.
            on_save: What the button "save" does; returns the name of the file.
            export_path: The file that the button "export" writes.
            can_pause: Show a button "pause".
        """
        up = as_real("up_world", up_world).astype(float)
        if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
            raise ValueError(f"up_world is {up_world}, expected 3 finite numbers, not all 0")
        self._given = stage.Given(exact_sdf, up / np.linalg.norm(up))
        self._lock = threading.RLock()
        self._moments: list[moments.Moment] = []
        self._shown: moments.Moment | None = None
        self._path = np.empty((0, 3), np.float32)
        self._spheres: stage.Spheres | None = None
        self._look = stage.Look(axis=int(np.argmax(np.abs(up))))
        self._on_save, self._export_path = on_save, export_path
        self.paused = False
        self._server = web_server.serve(host, port)
        shown_host = web_server.LOOPBACK if host in ("", "0.0.0.0") else host
        self.url = f"http://{shown_host}:{self._server.get_port()}"
        self._scales: list[colors.Scale] = []
        self._legend: Any = None
        self._build_panel(can_pause)

    def show(self, field: Field, cloud: Any = None, pose: Any = None) -> None:
        """Shows a later snapshot of the map; earlier ones stay on the time slider.

        Args:
            field: The snapshot.
            cloud: (N, 3) m, sensor frame: the newest cloud.
            pose: (4, 4) T_world_sensor: its pose.

        Raises:
            ValueError: An argument has a wrong type or shape.
        """
        if (cloud is None) != (pose is None):
            raise ValueError("cloud and pose belong together, expected both or neither")
        if cloud is not None:
            cloud, pose = _checked_frame(cloud, pose)
            self._walk(pose)
        moment = moments.capture(field, cloud, pose, self._path)
        with self._lock:
            is_first, follows = not self._moments, self._shows_newest()
            self._moments = moments.keep(self._moments, moment)
            if is_first:
                stage.prepare(self._server, moment, self._given)
                self._place_slice(moment, None if pose is None else pose[:3, 3])
            if follows:
                self._draw(moment)
            self._set_time()

    def show_sensor(self, cloud: Any, pose: Any) -> None:
        """Shows a new cloud and where the sensor is, in milliseconds; the map stays as it is.

        Args:
            cloud: (N, 3) m, sensor frame.
            pose: (4, 4) T_world_sensor.

        Raises:
            ValueError: An argument has a wrong type or shape.
        """
        cloud, pose = _checked_frame(cloud, pose)
        self._walk(pose)
        with self._lock:
            if self._moments and self._shows_newest():
                stage.draw_sensor(
                    self._server,
                    scene.thin_cloud(cloud, pose),
                    scene.sensor_lines(cloud, pose),
                    self._path,
                    self._look,
                )

    def show_robot(self, centers_world: Any, radii: Any) -> None:
        """Shows a robot as spheres, colored by their clearance.

        Args:
            centers_world: (K, 3) m.
            radii: (K,) m, or one for all.

        Raises:
            ValueError: A shape is wrong, or a radius is negative or not finite.
        """
        centers, radii = (
            np.asarray(each) for each in checked_spheres(centers_world, radii, "centers_world")
        )
        centers = centers.reshape(-1, 3)
        with self._lock:
            self._spheres = stage.Spheres(centers, np.broadcast_to(radii, len(centers)))
            if self._shown is not None:
                self._draw(self._shown)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Writes the view as one HTML file that needs no server and no network.

        It has the surface, the slice and the sensor as they are shown, and plays the stored
        snapshots.

        Args:
            path: The file.

        Raises:
            ValueError: Nothing is shown yet.
            OSError: The file cannot be written.
        """
        with self._lock:
            if not self._moments:
                raise ValueError("nothing is shown yet, expected a map to export")
            kept, look, robot = list(self._moments), self._look, self._spheres
        page.write_page(path, kept, look, self._given, robot)

    def close(self) -> None:
        """Ends the view."""
        web_server.stop(self._server)

    def _repr_html_(self) -> str:
        """The view itself, in a notebook on this machine."""
        return f'<iframe src="{self.url}" width="100%" height="600" style="border:0"></iframe>'

    def _walk(self, pose: np.ndarray) -> None:
        with self._lock:
            self._path = np.concatenate([self._path, pose[None, :3, 3]])

    def _shows_newest(self) -> bool:
        return self._shown is None or self._shown is self._moments[-1]

    def _draw(self, moment: moments.Moment) -> None:
        """Draws a moment, and the bars of its colors."""
        self._shown = moment
        scales = stage.draw(self._server, moment, self._look, self._given, self._spheres)
        with self._server.atomic():
            self._draw_legend(scales)
        self._title.content = f"**{moment.updates} updates**"

    def _draw_legend(self, scales: list[colors.Scale]) -> None:
        key = (scales, stage.notes(self._look))
        if key == self._scales:
            return
        self._scales = cast(Any, key)
        self._legend.image = colors.draw_bars(*key)
        self._legend.visible = True

    def _place_slice(self, moment: moments.Moment, sensor_world: np.ndarray | None) -> None:
        """Puts the slice halfway between the floor and the sensor, or the middle of the map."""
        low, high = np.asarray(moment.field.config.bounds, float)
        axis = self._look.axis
        at = (low + high)[axis] / 2
        if axis == np.argmax(np.abs(self._given.up_world)):
            floor = (low if self._given.up_world[axis] > 0 else high)[axis]
            at = (floor + (at if sensor_world is None else sensor_world[axis])) / 2
        at = float(np.clip(at, low[axis], high[axis]))
        self._look = dataclasses.replace(self._look, at_m=at)
        self._set_slider(low[axis], high[axis])

    def _set_slider(self, low: float, high: float) -> None:
        with self._quietly():
            self._at.min, self._at.max = round(float(low), 2), round(float(high), 2)
            self._at.value = round(self._look.at_m, 2)

    def _set_time(self) -> None:
        with self._quietly():
            self._time.visible = len(self._moments) > 1
            self._time.max = max(len(self._moments) - 1, 1)
            indices = [i for i, each in enumerate(self._moments) if each is self._shown]
            self._time.value = indices[0] if indices else self._time.value

    @contextlib.contextmanager
    def _quietly(self) -> Iterator[None]:
        """Lets values of the panel change without an effect."""
        self._quiet = True
        try:
            yield
        finally:
            self._quiet = False

    def _build_panel(self, can_pause: bool) -> None:
        gui, look = self._server.gui, self._look
        self._quiet = False
        self._title = gui.add_markdown("waiting for the first update, which compiles")
        known = ["height", "spread"] + ["error"] * (self._given.exact_sdf is not None)
        self._color = gui.add_dropdown("color by", known, initial_value=look.color)
        self._legend = gui.add_image(colors.draw_bars([], ["..."]), format="png", visible=False)
        self._axis = gui.add_dropdown("slice across", _AXES, initial_value=_AXES[look.axis])
        self._at = gui.add_slider("slice at [m]", -1.0, 1.0, 0.01, 0.0)
        self._time = gui.add_slider("snapshot", 0, 1, 1, 0, visible=False)
        boxes = {
            "surface": "surface",
            "slice": "slice",
            "unseen": "unseen space",
            "cloud": "newest cloud",
            "sensor": "sensor and path",
        }
        self._boxes = {
            name: gui.add_checkbox(label, getattr(look, name)) for name, label in boxes.items()
        }
        for each in (self._color, self._axis, self._at, *self._boxes.values()):
            each.on_update(lambda _: self._read_panel())
        self._time.on_update(lambda _: self._go_to(self._time.value))
        if can_pause:
            pause = gui.add_button("pause")

            @pause.on_click
            def _(_: object) -> None:
                self.paused = not self.paused
                pause.label = "continue" if self.paused else "pause"

        if self._on_save is not None:
            gui.add_button("save the map").on_click(lambda _: self._answer(self._on_save))
        gui.add_button("export as HTML").on_click(lambda _: self._answer(self._write_export))

    def _write_export(self) -> str:
        self.export(self._export_path)
        return os.fspath(self._export_path)

    def _answer(self, action: Callable[[], str] | None) -> None:
        """Does what a button asks for, and says in the browser how that went."""
        try:
            title, body = "written", action() if action is not None else ""
        except (OSError, ValueError) as error:
            title, body = "not written", str(error)
        for client in self._server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=10)

    def _read_panel(self) -> None:
        with self._lock:
            if self._quiet:
                return
            before, shown = self._look, self._shown
            axis = _AXES.index(self._axis.value)
            look = stage.Look(
                color=cast(scene.ColorBy, self._color.value),
                axis=axis,
                at_m=float(self._at.value),
                **{name: box.value for name, box in self._boxes.items()},
            )
            if look == before:  # a slider that is dragged asks more often than the map can answer
                return
            self._look = look
            if shown is None:
                return
            if axis != before.axis:
                self._place_slice(shown, None)
                look = self._look
            moved = dataclasses.replace(before, axis=look.axis, at_m=look.at_m)
            if look == moved:
                stage.draw_slice(self._server, shown, look)
            else:
                self._draw(shown)

    def _go_to(self, index: int) -> None:
        with self._lock:
            if self._quiet or not self._moments:
                return
            moment = self._moments[min(int(index), len(self._moments) - 1)]
            if moment is not self._shown:
                self._draw(moment)


def _checked_frame(cloud: Any, pose: Any) -> tuple[np.ndarray, np.ndarray]:
    cloud, pose = as_real("cloud", cloud), as_real("pose", pose).astype(np.float32)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"cloud has shape {cloud.shape}, expected (N, 3)")
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose has shape {pose.shape}, expected (4, 4) finite numbers")
    return cloud, pose
