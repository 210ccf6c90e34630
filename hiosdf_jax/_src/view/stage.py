"""Draws a moment of a map into a scene of viser."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.planning.clearance import sphere_clearance
from hiosdf_jax._src.view import colors, scene
from hiosdf_jax._src.view.moments import Moment

if TYPE_CHECKING:
    import viser

_AMBIENT, _SUN = 1.9, 1.3  # together pi: a surface that faces the sun has its own color
_CLOUD, _SENSOR, _PATH = (213, 94, 0), (20, 20, 20), (204, 60, 160)


@dataclasses.dataclass(frozen=True)
class Spheres:
    """The spheres of a robot.

    Attributes:
        centers_world: (K, 3) m.
        radii: (K,) m.
    """

    centers_world: np.ndarray
    radii: np.ndarray


@dataclasses.dataclass(frozen=True)
class Look:
    """What of a map is shown, and how.

    Attributes:
        color: What the colors of the surface say.
        axis: The slice is across x, y or z: 0, 1, 2.
        at_m: Where the slice is along that axis, m, world frame.
        surface: Show the surface.
        slice: Show the slice.
        unseen: Show where free space ends at unseen space.
        cloud: Show the newest cloud.
        sensor: Show the sensor and its path.
    """

    color: scene.ColorBy = "height"
    axis: int = 2
    at_m: float = 0.0
    surface: bool = True
    slice: bool = True
    unseen: bool = False
    cloud: bool = True
    sensor: bool = True


@dataclasses.dataclass(frozen=True)
class Given:
    """What does not change while a map is viewed.

    Attributes:
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m, if known.
        up_world: (3,) unit vector against gravity.
    """

    exact_sdf: Callable[[np.ndarray], np.ndarray] | None = None
    up_world: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))


def draw(
    server: viser.ViserServer,
    moment: Moment,
    look: Look,
    given: Given,
    spheres: Spheres | None = None,
) -> list[colors.Scale]:
    """Draws a moment; what was drawn before is replaced.

    Args:
        server: The server whose clients see it.
        moment: What to draw.
        look: What of it, and how.
        given: The truth and the vertical.
        spheres: A robot's spheres, colored by their clearance; unseen space is an obstacle.

    Returns:
        The scales of the colors that are in the picture.
    """
    scales = []
    with server.atomic():
        scales += _draw_surface(server, moment, look, given)
        scales += draw_slice(server, moment, look)
        _draw_unseen(server, moment, look)
        draw_sensor(server, moment.cloud_world, moment.sensor_world, moment.path_world, look)
        scales += _draw_spheres(server, moment, spheres)
    return scales


def draw_slice(server: viser.ViserServer, moment: Moment, look: Look) -> list[colors.Scale]:
    """Draws the slice alone; returns its scale."""
    if not look.slice:
        _clear(server, "/slice")
        return []
    plane = scene.cut(CompiledQueries(moment.field), look.axis, look.at_m)
    server.scene.add_image(
        "/slice",
        plane.image,
        plane.width_m,
        plane.height_m,
        format="png",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=_quaternion(plane.right_world, plane.down_world),
        position=plane.center_world,
    )
    return [colors.DISTANCE]


def draw_sensor(
    server: viser.ViserServer,
    cloud_world: np.ndarray,
    sensor_world: np.ndarray,
    path_world: np.ndarray,
    look: Look,
) -> None:
    """Draws the newest cloud, the sensor and its path; takes milliseconds."""
    if look.cloud and len(cloud_world):
        server.scene.add_point_cloud(
            "/cloud",
            cloud_world,
            _CLOUD,
            point_size=0.015,
            point_shape="circle",
            precision="float32",
        )
    else:
        _clear(server, "/cloud")
    path = scene.path_lines(path_world)
    for name, lines, color in (("/sensor", sensor_world, _SENSOR), ("/path", path, _PATH)):
        if look.sensor and len(lines):
            server.scene.add_line_segments(name, lines, color, thickness=0.03)
        else:
            _clear(server, name)


def notes(look: Look) -> list[str]:
    """Says what the colors mean that no bar explains."""
    said = ["grid: 1 m"]
    if look.slice:
        said.append("slice: black = surface, gray = not observed")
    if look.unseen:
        said.append("gray haze: where unseen space begins")
    if look.sensor or look.cloud:
        said.append("orange: newest cloud; black: sensor; pink: its path")
    return said


def prepare(server: viser.ViserServer, moment: Moment, given: Given) -> None:
    """Sets the vertical, the grid of 1 m and the camera, which looks down at the map at an angle.

    Args:
        server: The server.
        moment: The first moment.
        given: The vertical.
    """
    low, high = np.asarray(moment.field.config.bounds, float)
    middle, span = (low + high) / 2, high - low
    up = given.up_world
    axis = int(np.argmax(np.abs(up)))
    level = [k for k in range(3) if k != axis]
    server.scene.set_up_direction(up)
    # The lights of viser change the hue of colors that are to be read.
    server.scene.configure_default_lights(enabled=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/lights/ambient", intensity=_AMBIENT)
    server.scene.add_light_directional(
        "/lights/sun", intensity=_SUN, position=tuple(up + 0.4 * _any_level(up))
    )
    floor = np.where(up * np.eye(3)[axis] >= 0, low, high)[axis]
    below = middle.copy()
    below[axis] = floor
    server.scene.add_grid(
        "/grid",
        width=float(np.ceil(span[level[0]])),
        height=float(np.ceil(span[level[1]])),
        plane=("yz", "xz", "xy")[axis],
        cell_size=1.0,
        section_size=5.0,
        position=below,
    )
    back = np.zeros(3)
    back[level[int(np.argmin(span[level]))]] = -1.0  # the long side lies across the picture
    side = np.cross(back, up)
    reach = float(max(span[level].max(), 1.5 * span[level].min()))
    # The panel covers the right of the picture, and what is near looks larger than what is far.
    middle = middle + reach * (0.06 * back - 0.15 * side)
    camera = server.initial_camera
    camera.up = up
    camera.look_at = middle
    camera.position = middle + reach * (0.30 * back + 0.52 * up)


def _any_level(up: np.ndarray) -> np.ndarray:
    """A direction across `up`."""
    across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return across / np.linalg.norm(across)


def _draw_surface(
    server: viser.ViserServer, moment: Moment, look: Look, given: Given
) -> list[colors.Scale]:
    if not look.surface or not len(moment.mesh.faces):
        _clear(server, "/surface")
        return []
    painted, scale = scene.paint_surface(moment.mesh, look.color, given.exact_sdf, given.up_world)
    faces = scene.without_specks(moment.mesh, given.up_world)
    mesh = moment.mesh
    file = scene.as_glb(mesh.vertices, mesh.vertex_normals, faces, painted)
    server.scene.add_glb("/surface", file, cast_shadow=False, receive_shadow=False)
    return [scale]


def _draw_unseen(server: viser.ViserServer, moment: Moment, look: Look) -> None:
    vertices, faces = scene.edge_of_unseen(moment.field) if look.unseen else ((), ())
    if not len(faces):
        _clear(server, "/unseen")
        return
    server.scene.add_mesh_simple(
        "/unseen",
        np.asarray(vertices),
        np.asarray(faces),
        color=colors.UNSEEN,
        opacity=0.35,
        flat_shading=True,
        cast_shadow=False,
        receive_shadow=False,
    )


def _draw_spheres(
    server: viser.ViserServer, moment: Moment, spheres: Spheres | None
) -> list[colors.Scale]:
    if spheres is None or not len(spheres.radii):
        _clear(server, "/robot")
        return []
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    clearance = np.asarray(sphere_clearance(moment.field, spheres.centers_world, spheres.radii))
    server.scene.add_batched_meshes_simple(
        "/robot",
        np.asarray(ball.vertices),
        np.asarray(ball.faces),
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(spheres.radii), 1)),
        batched_positions=spheres.centers_world,
        batched_scales=spheres.radii,
        batched_colors=colors.CLEARANCE.paint(clearance),
        cast_shadow=False,
        receive_shadow=False,
    )
    return [colors.CLEARANCE]


def _clear(server: viser.ViserServer, name: str) -> None:
    handle: Any = server.scene.get_handle_by_name(name)
    if handle is not None:
        handle.remove()


def _quaternion(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The rotation (w, x, y, z) that turns a picture's right and down into these directions."""
    from scipy.spatial.transform import Rotation

    turn = np.stack([right, down, np.cross(right, down)], axis=1)
    return Rotation.from_matrix(turn).as_quat(scalar_first=True)
