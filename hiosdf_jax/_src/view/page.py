"""A view as one HTML file, with viser's client and all data inside it."""

from __future__ import annotations

import base64
import io
import os

from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.view import colors, stage, web_server
from hiosdf_jax._src.view.moments import Moment

_MOST_FRAMES = 12  # a snapshot of a house takes about 2 MB
_SECONDS_PER_FRAME = 1.0
_SECONDS_AT_END = 4.0


def write_page(
    path: str | os.PathLike[str],
    moments: list[Moment],
    look: stage.Look,
    given: stage.Given | None = None,
    spheres: stage.Spheres | None = None,
) -> None:
    """Writes moments of a map as a page that plays them, with the bars of its colors.

    The scene is drawn by a server of its own, so that nobody who watches sees it.

    Args:
        path: The file.
        moments: The moments, oldest first; at most 12 of them are used, the last one always.
        look: What of them is shown.
        given: The truth and the vertical.
        spheres: The spheres of a robot.

    Raises:
        OSError: The file cannot be written.
        ModuleNotFoundError: viser is not installed.
    """
    given = given or stage.Given()
    step = -(-len(moments) // _MOST_FRAMES)
    played = moments[::-1][::step][::-1]
    server = web_server.serve(port=0)
    try:
        stage.prepare(server, played[-1], given)
        stage.draw(server, played[0], look, given, spheres)
        recording = server.get_scene_serializer()
        scales = []
        for moment in played:
            if moment is not played[0]:
                recording.insert_sleep(_SECONDS_PER_FRAME)
            scales = stage.draw(server, moment, look, given, spheres)
        if len(played) > 1:
            recording.insert_sleep(_SECONDS_AT_END)
        document = recording.as_html()
    finally:
        web_server.stop(server)
    picture = _as_png(colors.draw_bars(scales, stage.notes(look)))
    legend = (
        '<img alt="legend" style="position:fixed;right:12px;top:12px;width:300px;z-index:9;'
        f'border:1px solid #ccc;background:#fff" src="data:image/png;base64,{picture}">'
    )
    head, tail = document.rsplit("</body>", 1)
    with replacing(path) as file:
        file.write(f"{head}{legend}</body>{tail}".encode())


def _as_png(picture: object) -> str:
    from PIL import Image

    with io.BytesIO() as file:
        Image.fromarray(picture).save(file, "png")  # pyright: ignore[reportArgumentType]
        return base64.b64encode(file.getvalue()).decode()
