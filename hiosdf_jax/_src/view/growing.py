"""A growing map as an animated GIF."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.view.shading import shade, viewpoint

if TYPE_CHECKING:
    import trimesh
    from PIL import Image

_SIZE = (640, 480)
_FRAME_MS, _LAST_MS = 300, 2500
_PATH_COLOR = (204, 60, 160)
_DOT_PIXELS = 4  # radius of the dot where the sensor is


class MapSoFar(NamedTuple):
    """A map that is still growing.

    Attributes:
        mesh: Its surface.
        path_world: (F, 3) m, the sensor's positions so far.
    """

    mesh: trimesh.Trimesh
    path_world: np.ndarray


def save_growing(
    path: str | os.PathLike[str], maps: Sequence[MapSoFar], up_world: np.ndarray
) -> None:
    """Draws how a map grows, with the path of the sensor, as an animated GIF.

    All pictures have the viewpoint and the colors of the last one. If that shows no surface,
    nothing is written.

    Args:
        path: The file.
        maps: The map at different times, oldest first, at least one.
        up_world: (3,) unit vector against gravity.

    Raises:
        OSError: The file cannot be written.
    """
    view = viewpoint(maps[-1].mesh, _SIZE, up_world) if len(maps[-1].mesh.faces) else None
    if view is None:
        return
    pictures = []
    for mesh, path_world in maps:
        pictures.append(_with_path(shade(mesh, view), view.pixels(path_world)))
    # One palette for all, since each with its own would flicker. The path keeps its exact color.
    palette = pictures[-1].quantize(254)
    colors = (palette.getpalette() or [])[: 3 * 254]
    palette.putpalette([*colors, *_PATH_COLOR])
    frames = [each.quantize(palette=palette, dither=0) for each in pictures]
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_MS]
    with replacing(path) as file:
        frames[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=frames[1:],
            duration=durations,
            loop=0,
        )


def _with_path(picture: np.ndarray, pixels: np.ndarray) -> Image.Image:
    from PIL import Image, ImageDraw

    image = Image.fromarray(np.rint(255 * picture).astype(np.uint8))
    pen = ImageDraw.Draw(image)
    corners = [(float(column), float(row)) for column, row in pixels]
    pen.line(corners, fill=_PATH_COLOR, width=2)
    for column, row in corners[-1:]:
        box = (column - _DOT_PIXELS, row - _DOT_PIXELS, column + _DOT_PIXELS, row + _DOT_PIXELS)
        pen.ellipse(box, fill=_PATH_COLOR, outline=(0, 0, 0))
    return image
