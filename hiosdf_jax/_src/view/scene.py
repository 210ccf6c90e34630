"""What a live view shows, as arrays and colors: pure functions of a map."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.state.pytrees import Field, Side
from hiosdf_jax._src.view import colors
from hiosdf_jax._src.view.shading import remains_of_ceiling
from hiosdf_jax._src.view.slices import CHUNK

if TYPE_CHECKING:
    import trimesh

ColorBy = Literal["height", "spread", "error"]

_MOST_POINTS = 20_000  # of the newest cloud; more hide each other
_FRUSTUM_M = 0.8  # length of the drawn frustum
_REACH_PIXELS = 1.0  # a pixel this close to a zero of the distance is drawn as surface
_UP = np.array([0.0, 0.0, 1.0])
_SURFACE = (0, 0, 0)


@dataclasses.dataclass(frozen=True)
class SlicePlane:
    """A slice of a map as a picture that stands in the world.

    Attributes:
        image: (H, W, 3) uint8; rows run down `down_world`, columns along `right_world`.
        center_world: (3,) m.
        width_m: Size along the columns.
        height_m: Size along the rows.
        right_world: (3,) unit vector.
        down_world: (3,) unit vector.
    """

    image: np.ndarray
    center_world: np.ndarray
    width_m: float
    height_m: float
    right_world: np.ndarray
    down_world: np.ndarray


def paint_surface(
    mesh: trimesh.Trimesh,
    by: ColorBy,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None = None,
    up_world: np.ndarray = _UP,
) -> tuple[np.ndarray, colors.Scale]:
    """Colors the vertices of a mesh from `hiosdf_jax.extract_mesh`.

    Args:
        mesh: The mesh, m, world frame.
        by: "height"; "spread", the standard deviation of the hits; or "error", the exact distance
            of the mapped surface to the true one.
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m; for "error".
        up_world: (3,) unit vector against gravity; for "height".

    Returns:
        (V, 3) uint8, and the scale that explains them.

    Raises:
        ValueError: `by` is something else, or "error" without `exact_sdf`.
    """
    vertices = np.asarray(mesh.vertices, np.float32)
    if by == "height":
        heights = vertices @ np.asarray(up_world, np.float32)
        scale = colors.height_scale(heights)
        return scale.paint(heights), scale
    if by == "spread":
        scale = colors.spread_scale()
        spread = mesh.vertex_attributes.get("spread", np.empty(0))
        return scale.paint(100 * np.asarray(spread)), scale
    if by != "error" or exact_sdf is None:
        wanted = "height or spread" if exact_sdf is None else "height, spread or error"
        raise ValueError(f"color is {by!r}, expected {wanted}")
    scale = colors.error_scale()
    return scale.paint(100 * np.asarray(exact_sdf(vertices), float)), scale


def as_glb(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, painted: np.ndarray
) -> bytes:
    """Writes a mesh as binary glTF, whose colors look as they do on a screen.

    Args:
        vertices: (V, 3).
        normals: (V, 3) unit vectors.
        faces: (F, 3).
        painted: (V, 3) uint8, the colors of the vertices.

    Returns:
        The file.
    """
    import trimesh

    mesh = trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=colors.to_linear(painted),
        process=False,
    )
    with io.BytesIO() as file:
        mesh.export(file, file_type="glb", tree_postprocessor=_make_dull)
        return file.getvalue()


def _make_dull(tree: dict[str, Any]) -> None:
    """Gives the meshes of a glTF tree a material; without one they are of polished metal."""
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def without_specks(mesh: trimesh.Trimesh, up_world: np.ndarray = _UP) -> np.ndarray:
    """Leaves out the upper sides of a rough ceiling, which hide a room from a view from above.

    Args:
        mesh: The mesh, with normals toward free space.
        up_world: (3,) unit vector against gravity.

    Returns:
        (F, 3) the faces to show: all that look down or sideways, and of those that look up all but
        small pieces high above the rest.
    """
    faces = np.asarray(mesh.faces)
    normals = np.asarray(mesh.face_normals)
    looks_up = normals @ up_world > 0.1
    if not looks_up.any():
        return faces
    area = np.asarray(mesh.area_faces)[looks_up]
    level = np.asarray(mesh.vertices) @ up_world
    shown = np.ones(len(faces), bool)
    shown[looks_up] = ~remains_of_ceiling(level, faces[looks_up], area)
    return faces[shown]


def cut(queries: CompiledQueries, axis: int, at_m: float) -> SlicePlane:
    """Cuts a map along a plane across an axis of the world.

    The picture has about 16,000 pixels, one evaluation of the map.

    Args:
        queries: The queries of the map.
        axis: 0, 1 or 2: the plane is x, y or z = `at_m`.
        at_m: Where, m.

    Returns:
        The slice: distances in the colors of `colors.DISTANCE`, surfaces black, unobserved space
        gray.
    """
    from scipy.ndimage import maximum_filter

    low, high = np.asarray(queries.field.config.bounds, float)
    across, along = [k for k in range(3) if k != axis]  # columns, rows
    span = high - low
    pixel_m = np.sqrt(span[across] * span[along] / CHUNK) * 1.01
    columns, rows = (max(int(span[k] / pixel_m), 1) for k in (across, along))
    points = np.empty((rows, columns, 3), np.float32)
    points[..., axis] = at_m
    points[..., across] = low[across] + (np.arange(columns) + 0.5) * span[across] / columns
    # The first row is the upper one.
    points[..., along] = high[along] - (np.arange(rows)[:, None] + 0.5) * span[along] / rows
    flat = points.reshape(-1, 3)
    sdf, seen = np.empty(len(flat), np.float32), np.empty(len(flat), bool)

    def ask(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(queries.sdf(flat[row])), np.asarray(queries.observed(flat[row]))

    fill_in_chunks(ask, {"sdf": sdf, "observed": seen}, CHUNK)
    sdf, seen = sdf.reshape(rows, columns), seen.reshape(rows, columns)
    image = np.where(seen[..., None], colors.DISTANCE.paint(sdf), np.array(colors.UNSEEN, np.uint8))
    near = maximum_filter(seen, 3)  # surfaces lie at the edge of observed space
    image[near & (np.abs(sdf) < _REACH_PIXELS * pixel_m / 2)] = _SURFACE
    center = (low + high) / 2
    center[axis] = at_m
    right, down = np.zeros(3), np.zeros(3)
    right[across], down[along] = 1.0, -1.0
    return SlicePlane(image, center, float(span[across]), float(span[along]), right, down)


def edge_of_unseen(field: Field) -> tuple[np.ndarray, np.ndarray]:
    """Finds where free space ends at unseen space.

    Args:
        field: A snapshot of a map.

    Returns:
        vertices: (4 Q, 3) float32 m, world frame: four corners of each square, the size of a
            voxel's face.
        faces: (2 Q, 3) int32: two triangles of each square. They face free space.
    """
    config, derived = field.config, field.surface.derived
    unseen = np.asarray(derived.frontier_steps) <= 0
    free = ~unseen & (np.asarray(derived.side) == Side.FREE)
    corners = []
    for axis in range(3):
        lower = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        upper = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        step = np.eye(3, dtype=int)
        u, v = step[(axis + 1) % 3], step[(axis + 2) % 3]  # u x v points along the axis
        for is_edge, first, second in (
            (unseen[lower] & free[upper], u, v),  # faces up the axis
            (free[lower] & unseen[upper], v, u),
        ):
            at = np.argwhere(is_edge) + step[axis]
            corners.append(np.stack([at, at + first, at + first + second, at + second], axis=1))
    found = np.concatenate(corners).reshape(-1, 3)
    vertices = ((found + config.corner_index) * config.voxel_size).astype(np.float32)
    square = 4 * np.arange(len(found) // 4, dtype=np.int32)[:, None]
    return vertices, (square + np.array([0, 1, 2, 0, 2, 3], np.int32)).reshape(-1, 3)


def thin_cloud(cloud: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Places the newest cloud in the world, without rows that are not returns.

    Args:
        cloud: (N, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.

    Returns:
        (n, 3) float32 m, world frame; at most 20,000 of them, evenly chosen.
    """
    cloud = np.asarray(cloud, np.float32)
    cloud = cloud[np.isfinite(cloud).all(axis=-1)]
    cloud = cloud[:: -(-len(cloud) // _MOST_POINTS) or 1]
    pose = np.asarray(pose, np.float32)
    return cloud @ pose[:3, :3].T + pose[:3, 3]


def sensor_lines(cloud: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Outlines the sensor: the frustum of a camera, or the three axes of a LiDAR.

    Args:
        cloud: (N, 3) m, sensor frame; its extent is that of the frustum.
        pose: (4, 4) T_world_sensor.

    Returns:
        (L, 2, 3) float32 m, world frame: the ends of the lines.
    """
    cloud = np.asarray(cloud, float)
    cloud = cloud[np.isfinite(cloud).all(axis=-1)]
    if len(cloud) and (cloud[:, 2] > 0).all():
        (x0, y0), (x1, y1) = np.percentile(cloud[:, :2] / cloud[:, 2:], [0.5, 99.5], axis=0)
        corners = _FRUSTUM_M * np.array([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1]])
        ends = [(np.zeros(3), corner) for corner in corners]
        ends += list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    else:
        ends = [(np.zeros(3), _FRUSTUM_M / 2 * axis) for axis in np.eye(3)]
    pose = np.asarray(pose, float)
    return (np.array(ends) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def path_lines(path_world: np.ndarray) -> np.ndarray:
    """Joins the positions (F, 3) m of the sensor to lines (F - 1, 2, 3)."""
    path = np.asarray(path_world, np.float32).reshape(-1, 3)
    return np.stack([path[:-1], path[1:]], axis=1)
