"""The path of a sensor as a picture: from above, and how far it was corrected."""

from __future__ import annotations

import os

import numpy as np

from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.view.leveling import is_tilted, world_from_level

_MOST_SPREAD_CM = 1000.0  # larger ones are of directions of which nothing is known


def save_paths(
    path: str | os.PathLike[str],
    given_world: np.ndarray | None,
    refined_world: np.ndarray,
    registered: np.ndarray,
    spread_cm: np.ndarray,
    up_world: np.ndarray,
) -> None:
    """Draws a path as it was given, if it was, and as it was refined.

    Args:
        path: The picture; its suffix names the format.
        given_world: (F, 3) m, the sensor's positions before, or None.
        refined_world: (F, 3) m, and after.
        registered: (F,) bool; the others are marked.
        spread_cm: (F,) cm, standard deviation of the refined positions in the map.
        up_world: (3,) unit vector against gravity; the picture looks down along it.

    Raises:
        OSError: The picture cannot be written.
    """
    from matplotlib.figure import Figure  # not pyplot: draws with Agg

    rotation = world_from_level(up_world)
    frame_name = "leveled" if is_tilted(up_world) else "world"
    refined = (refined_world @ rotation)[:, :2]
    frame = np.arange(len(refined))

    figure = Figure(figsize=(12, 5.5), layout="constrained")
    above, over_time = figure.subplots(1, 2)
    if given_world is not None:
        given = (given_world @ rotation)[:, :2]
        above.plot(*given.T, color="0.6", linewidth=3, label="poses of the stream")
        way_cm = 100 * np.linalg.norm(refined_world - given_world, axis=-1)
        over_time.plot(
            frame, way_cm, color="0.4", label="from the stream's to the registered position"
        )
    above.plot(*refined.T, color="tab:blue", label="registered in the map")
    above.plot(*refined[0], "o", color="tab:green", label="start")
    if not registered.all():
        above.plot(*refined[~registered].T, "x", color="tab:red", label="not registered")
    above.set(xlabel=f"x ({frame_name}), m", ylabel=f"y ({frame_name}), m", title="from above")
    above.set_aspect("equal")
    above.set_adjustable("datalim")
    above.legend()
    known = registered & (spread_cm < _MOST_SPREAD_CM)
    over_time.plot(
        frame,
        np.where(known, spread_cm, np.nan),
        color="tab:blue",
        label="standard deviation in the map",
    )
    over_time.set(xlabel="frame", ylabel="cm", title="corrections")
    over_time.xaxis.get_major_locator().set_params(integer=True)
    over_time.margins(y=0.25)  # room for the legend
    over_time.set_ylim(bottom=0)
    over_time.legend()
    with replacing(path) as file:
        figure.savefig(file, format=os.fspath(path).rpartition(".")[2], dpi=100)
