"""Shaded pictures of meshes, by a small software rasterizer without GL or display.

Scan conversion is exact and vectorized over faces. A surface has no holes, whatever the size of its
triangles, and a million faces take seconds in numpy.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hiosdf_jax._src.output_files import replacing

if TYPE_CHECKING:
    import trimesh

_SUPERSAMPLING = 2  # samples along each side of a pixel
_ELEVATION = np.deg2rad(52)  # of the camera, high enough to look over the walls of a room
_AZIMUTH = np.deg2rad(24)  # off the long side; a view square onto it shows no second wall
_MARGIN = 0.03  # share of the picture that stays free on each side
# These two bound the memory beyond the mesh and the picture.
_FACES_PER_BATCH = 20_000
_ROWS_PER_BAND = 64
_AMBIENT = 0.2
_LIGHT = np.array([-0.35, 0.7, 0.9])  # direction to it: right, level toward the viewer, up
_PALETTE = np.array(  # by height, from low to high; pale, so that the shading shows the shape
    [[0.80, 0.86, 0.94], [0.99, 0.93, 0.82], [0.98, 0.76, 0.56], [0.86, 0.57, 0.53]]
)


# Pieces of a rough ceiling lie above this share of the height and have less than this share of the
# area.
_HIGH, _SMALL = 0.6, 0.02


def save_shaded(
    path: str | os.PathLike[str],
    mesh: trimesh.Trimesh,
    size: tuple[int, int] = (1280, 960),
    up_world: Sequence[float] = (0.0, 0.0, 1.0),
) -> None:
    """Draws a mesh from above at an angle, shaded and tinted by height, on white.

    Faces that look away from the camera are left out, so the view passes through the ceiling and
    the near walls into a mapped room. The long side of the mesh lies across the picture.

    Example:
        save_shaded("mesh.png", hio.extract_mesh(field))

    Args:
        path: The picture; its suffix names the format (.png).
        mesh: Faces with normals toward free space, m.
        size: (width, height) in pixels.
        up_world: (3,) direction against gravity in the mesh's frame, of any length.

    Raises:
        ValueError: The mesh has no faces, size is not two positive numbers, or up_world is not a
            finite (3,) vector other than zero.
        OSError: The picture cannot be written.
    """
    import matplotlib.image

    if not len(mesh.faces):
        raise ValueError("mesh has 0 faces, expected at least 1")
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"size = {size}, expected (width, height) > 0 in pixels")
    up = np.asarray(up_world, float)
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise ValueError(f"up_world = {up_world}, expected 3 finite numbers, not all 0")
    up = up / np.linalg.norm(up)
    view = viewpoint(mesh, size, up)
    picture = np.ones((size[1], size[0], 3)) if view is None else shade(mesh, view)
    with replacing(path) as file:
        matplotlib.image.imsave(file, picture, format=Path(path).suffix[1:] or "png")


class Viewpoint(NamedTuple):
    """From where a mesh is drawn: a parallel projection, chosen by `viewpoint`.

    Attributes:
        size: (width, height) of the picture in pixels.
        axes: (3, 3), rows: right, up and toward the viewer of the picture, world frame.
        middle: (2,) m along right and up, what the middle of the picture shows.
        nearest: m along the third axis, the point nearest to the viewer.
        scale: Samples per m; a pixel has 2 x 2 samples.
        up_world: (3,) unit vector against gravity.
        heights: Lowest and highest height of the palette, m along `up_world`.
    """

    size: tuple[int, int]
    axes: np.ndarray
    middle: np.ndarray
    nearest: float
    scale: float
    up_world: np.ndarray
    heights: tuple[float, float]

    def project(self, points_world: np.ndarray) -> np.ndarray:
        """Where points lie in the picture.

        Args:
            points_world: (..., 3) m.

        Returns:
            (..., 3) column, row and depth in samples, (0, 0) in the middle of the upper left one.
        """
        width, height = (_SUPERSAMPLING * side for side in self.size)
        view = points_world @ self.axes.T
        column = (view[..., 0] - self.middle[0]) * self.scale + (width - 1) / 2
        row = (self.middle[1] - view[..., 1]) * self.scale + (height - 1) / 2
        return np.stack([column, row, (self.nearest - view[..., 2]) * self.scale], axis=-1)

    def pixels(self, points_world: np.ndarray) -> np.ndarray:
        """The column and row of points, in pixels: (..., 2)."""
        return (self.project(points_world)[..., :2] + 0.5) / _SUPERSAMPLING - 0.5


def viewpoint(mesh: trimesh.Trimesh, size: tuple[int, int], up: np.ndarray) -> Viewpoint | None:
    """Chooses a viewpoint that shows a whole mesh.

    Args:
        mesh: The mesh.
        size: (width, height) in pixels.
        up: (3,) unit vector against gravity.

    Returns:
        The viewpoint; None if all faces look away from it.
    """
    axes = _camera_axes(np.asarray(mesh.vertices, float), up)
    corners, _ = _shown(mesh, axes, up)
    if not len(corners):
        return None
    view = corners @ axes.T  # m along the picture's right, up and toward the viewer
    lower, upper = view.min(axis=(0, 1)), view.max(axis=(0, 1))
    width, height = (_SUPERSAMPLING * side for side in size)
    extent = upper - lower
    scale = (1 - 2 * _MARGIN) * min(width / extent[0], height / extent[1])
    middle = (lower + upper) / 2
    low, high = np.percentile(corners @ up, [1, 99])
    return Viewpoint(size, axes, middle[:2], upper[2], scale, up, (low, high))


def shade(mesh: trimesh.Trimesh, view: Viewpoint) -> np.ndarray:
    """Draws a mesh; faces that are not wholly in the picture are left out.

    Args:
        mesh: The mesh.
        view: From where.

    Returns:
        (height, width, 3) in 0..1.
    """
    size, up, camera = view.size, view.up_world, view.axes
    width, height = (_SUPERSAMPLING * side for side in size)
    corners, normal = _shown(mesh, camera, up)
    projected = view.project(corners)
    # A mesh that the viewpoint was chosen for is inside, but for rounding.
    inside = (projected[..., :2] >= 0) & (projected[..., :2] <= [width - 1, height - 1])
    inside = inside.all(axis=(1, 2)) & (projected[..., 2] > -1e-6 * max(size)).all(axis=1)
    projected, normal = projected[inside], normal[inside]
    face, depth = _rasterize(np.maximum(projected, 0), width, height)
    covered = face >= 0

    light = _LIGHT @ np.stack([camera[0], np.cross(camera[0], up), up])
    # Wrapped Lambert shading: a wall in the shade still shows its shape.
    cosine = normal @ light / np.linalg.norm(light)
    brightness = _AMBIENT + (1 - _AMBIENT) * (1 + cosine) / 2
    low, high = view.heights
    stops = np.linspace(low, max(high, low + 1e-9), len(_PALETTE))
    darkening = _occlusion(depth, covered)
    image = np.ones((size[1], size[0], 3))
    for top in range(0, size[1], _ROWS_PER_BAND):
        band = slice(_SUPERSAMPLING * top, _SUPERSAMPLING * (top + _ROWS_PER_BAND))
        inside = covered[band]
        # From samples back to m: the height of the surface at each sample.
        rows = np.nonzero(inside)[0] + band.start
        level = (view.middle[1] + ((height - 1) / 2 - rows) / view.scale) * (camera[1] @ up)
        level += (view.nearest - depth[band][inside] / view.scale) * (camera[2] @ up)
        factor = brightness[face[band][inside]] * darkening[band][inside]
        fine = np.ones((*inside.shape, 3))
        for k, channel in enumerate(_PALETTE.T):
            fine[inside, k] = np.interp(level, stops, channel) * factor
        blocks = fine.reshape(-1, _SUPERSAMPLING, size[0], _SUPERSAMPLING, 3)
        image[top : top + _ROWS_PER_BAND] = blocks.mean(axis=(1, 3))
    return np.clip(image, 0, 1)


def _shown(
    mesh: trimesh.Trimesh, camera: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The faces that a picture shows: their corners (F, 3, 3) m, and their normals (F, 3)."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces).reshape(-1, 3)
    a, b, c = vertices[faces.T]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1)
    shown = normal @ camera[2] > 1e-12 * length  # the others look away, or have no area
    if shown.any():
        shown[shown] = ~remains_of_ceiling(vertices @ up, faces[shown], length[shown])
    return vertices[faces[shown]], normal[shown] / length[shown, None]


def remains_of_ceiling(level: np.ndarray, faces: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Returns a mask of the faces of small pieces near the top, remains of a rough ceiling.

    Args:
        level: (V,) height of each vertex.
        faces: (F, 3) vertices of each face.
        area: (F,) area of each face, in any unit.

    Returns:
        (F,) bool.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), edges.T), (len(level), len(level)))
    count, piece = connected_components(graph, directed=False)
    piece = piece[faces[:, 0]]
    lowest = np.full(count, np.inf)
    np.minimum.at(lowest, piece, level[faces].min(axis=1))
    low, high = np.percentile(level[faces], [1, 99])
    floats = lowest > low + _HIGH * (high - low)
    is_small = np.bincount(piece, area, count) < _SMALL * area.sum()
    return (floats & is_small)[piece]


def _camera_axes(vertices: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The camera's axes as rows, (3, 3): right, up and toward the viewer of the picture."""
    # Any two level axes serve to find the long side.
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    level = np.stack([first, np.cross(up, first)])
    flat = (vertices - vertices.mean(axis=0)) @ level.T
    long_side = np.linalg.eigh(flat.T @ flat)[1][:, 1] @ level
    # The sign follows the largest axis of the frame, so that later pictures of one place do not
    # turn around.
    long_side *= np.sign(long_side[np.argmax(np.abs(long_side))])
    away = np.cross(up, long_side)
    right = np.cos(_AZIMUTH) * long_side + np.sin(_AZIMUTH) * away
    back = np.cross(right, up)
    viewer = np.cos(_ELEVATION) * back + np.sin(_ELEVATION) * up
    return np.stack([right, np.cross(viewer, right), viewer])


def _rasterize(corners: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest face at each pixel.

    Args:
        corners: (F, 3, 3), column, row and depth of each corner of each face.
        width: Number of columns; pixel centers are at integers.
        height: Number of rows.

    Returns:
        face: (height, width) int, -1 for none.
        depth: (height, width) depth of that face, inf for none.
    """
    # Depth in the high bits and the face in the low bits: one minimum finds both.
    nothing = np.iinfo(np.int64).max
    deepest = corners[..., 2].max(initial=1)
    steps = (2**31 - 2) / deepest
    buffer = np.full(height * width, nothing)
    # depth = origin + slope . (column, row), the plane through the corners
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_1, edge_2)
    normal[np.abs(normal[:, 2]) < 1e-12, 2] = np.inf
    slope = -normal[:, :2] / normal[:, 2:]
    origin = corners[:, 0, 2] - np.sum(slope * corners[:, 0, :2], axis=-1)
    near, far = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)

    for start in range(0, len(corners), _FACES_PER_BATCH):
        part = slice(start, start + _FACES_PER_BATCH)
        which, row, column = _fragments(corners[part, :, :2])
        which += start
        depth = origin[which] + slope[which, 0] * column + slope[which, 1] * row
        depth = np.clip(depth, near[which], far[which])  # a face seen edge-on has any slope
        key = ((depth * steps).astype(np.int64) << 32) | which
        np.minimum.at(buffer, row * width + column, key)
    buffer = buffer.reshape(height, width)
    empty = buffer == nothing
    return (
        np.where(empty, -1, buffer & (2**32 - 1)),
        np.where(empty, np.inf, (buffer >> 32) / steps),
    )


def _fragments(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lists the pixels in faces: the face, the row and the column, (n,) each.

    Args:
        corners: (F, 3, 2), column and row of each corner of each face.
    """
    slack = 1e-6  # pixels; neighbors round their common edge differently
    first = np.ceil(corners[..., 1].min(axis=1) - slack).astype(int)
    last = np.floor(corners[..., 1].max(axis=1) + slack).astype(int)
    face, row = _ranges(first, last)
    # On each row a face covers the columns between its edges.
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for i in range(3):
        (x0, y0), (x1, y1) = corners[face, i].T, corners[face, (i + 1) % 3].T
        level = y1 == y0  # the ends of a level edge belong to the two other edges
        t = (row - y0) / np.where(level, 1, y1 - y0)
        crosses = ~level & (t >= -slack) & (t <= 1 + slack)
        x = x0 + t * (x1 - x0)
        left = np.where(crosses, np.minimum(left, x), left)
        right = np.where(crosses, np.maximum(right, x), right)
    found = right >= left
    face, row = face[found], row[found]
    left = np.ceil(left[found] - slack).astype(int)
    right = np.floor(right[found] + slack).astype(int)
    span, column = _ranges(left, right)
    return face[span], row[span], column


def _ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lists the integers from first[i] to last[i] for all i; returns each i and integer, (n,)."""
    count = np.maximum(last - first + 1, 0)
    which = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return which, np.arange(len(which)) - before[which] + first[which]


def _occlusion(depth: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Darkens pixels that lie behind their surroundings, as a stand-in for ambient occlusion.

    After Luft et al., Image enhancement by unsharp masking the depth buffer (SIGGRAPH 2006).

    Args:
        depth: (H, W) pixels.
        covered: (H, W) bool.

    Returns:
        (H, W) factors <= 1.
    """
    from scipy.ndimage import uniform_filter

    def blur(image: np.ndarray, radius: float) -> np.ndarray:
        # Two boxes have the variance of a Gaussian, at a cost that does not grow with the radius.
        width = max(round((6 * radius**2 + 1) ** 0.5), 1)
        return uniform_filter(uniform_filter(image, width), width)

    factor = np.ones(depth.shape, np.float32)
    known = np.where(covered, depth, 0).astype(np.float32)
    for share in (1 / 300, 1 / 80):
        radius = share * max(depth.shape)
        weight = blur(covered.astype(np.float32), radius)
        around = blur(known, radius) / np.maximum(weight, 1e-6)
        behind = np.clip((known - around) / (8 * radius), 0, 1)
        factor *= 1 - 0.35 * behind
    return factor
