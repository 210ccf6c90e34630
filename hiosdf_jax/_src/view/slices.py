"""Horizontal slices of a map as a picture: the map, the exact distance and the difference."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.output_files import replacing

if TYPE_CHECKING:
    import trimesh
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

_COLUMNS = 400  # samples along the longer side of a slice
CHUNK = 16384  # points per query; one shape, so that a jitted map compiles once
_ERROR_CM = 10.0  # end of the color scale of errors
_PANEL_INCHES = 5.0
_SURFACE_REACH = 0.15  # m; surfaces lie at the edge of observed space, or a voxel beyond


def save_slices(
    path: str | os.PathLike[str],
    sdf: Callable[[np.ndarray], Any],
    truth_sdf: Callable[[np.ndarray], Any] | None,
    bounds: Sequence[Sequence[float]],
    heights: Sequence[float],
    path_world: np.ndarray | None = None,
    observed: Callable[[np.ndarray], Any] | None = None,
    mesh: trimesh.Trimesh | None = None,
) -> None:
    """Draws slices of a map at constant z, one row per height (as in Fig. 4 of the paper).

    Each row shows the map and, with `truth_sdf`, the exact distance in the same colors and the
    signed error. Surfaces are black lines; unobserved space is gray.

    Example:
        field = hio.snapshot(state)
        bounds = field.config.bounds
        save_slices("slices.png", lambda points: hio.sdf(field, points), None, bounds, [0.5, 1.2])

    Args:
        path: The picture; its suffix names the format.
        sdf: Maps (n, 3) float32 points, m, world frame, to (n,) distances, m. Every call has the
            same n, for the other callables too.
        truth_sdf: The exact distance; None if there is no ground truth.
        bounds: ((x0, y0, z0), (x1, y1, z1)) m, world frame; z is not used.
        heights: z of each slice, m, world frame.
        path_world: (F, 3) m, the path of the sensor, drawn on top.
        observed: Maps (n, 3) points to (n,) bool.
        mesh: The surface of the map, m, world frame. By default the zero level of `sdf` is drawn,
            which closes around both sides of a thin wall.

    Raises:
        ValueError: There are no heights, bounds is not (2, 3) with a positive size in x and y, or a
            callable returned the wrong shape.
        OSError: The picture cannot be written.
    """
    # Not pyplot: this draws with Agg, whatever backend the user has.
    from matplotlib.figure import Figure

    box = np.asarray(bounds, float)
    if box.shape != (2, 3) or not (box[1, :2] > box[0, :2]).all():
        raise ValueError(f"bounds = {bounds}, expected ((x0, y0, z0), (x1, y1, z1)), x0 < x1, ...")
    if not len(heights):
        raise ValueError("heights is empty, expected at least one z in meters")
    x, y = _axes(box)
    rows = []
    for height in heights:
        points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], axis=-1)
        panels = [_sample(sdf, points, "sdf")]
        if truth_sdf is not None:
            panels.append(_sample(truth_sdf, points, "truth_sdf"))
            panels.append(100 * (panels[0] - panels[1]))
        seen = None if observed is None else _sample(observed, points, "observed") > 0.5
        rows.append((panels, seen))
    # In unobserved space a map may return anything, which must not set the scale.
    shown = [p[slice(None) if seen is None else seen] for ps, seen in rows for p in ps[:2]]
    shown = np.abs(np.concatenate([panel.ravel() for panel in shown]))
    limit = float(np.nanpercentile(shown, 99)) if shown.any() else 1.0

    titles = ("map", "exact", "map - exact")[: len(rows[0][0])]
    span = box[1, :2] - box[0, :2]
    row_inches = _PANEL_INCHES * span[1] / span[0] + 0.45
    figure = Figure(
        figsize=(_PANEL_INCHES * len(titles) + 0.7, row_inches * len(rows) + 1.4),
        layout="constrained",
    )
    grid = figure.subplots(len(rows), len(titles), squeeze=False, sharex=True, sharey=True)
    image = {"extent": (*box[:, 0], *box[:, 1]), "origin": "lower", "interpolation": "nearest"}
    distance = {"cmap": "RdBu", "vmin": -limit, "vmax": limit}
    error = {"cmap": "PuOr_r", "vmin": -_ERROR_CM, "vmax": _ERROR_CM}
    for axes, height, (panels, seen) in zip(grid, heights, rows, strict=True):
        for i, (ax, panel) in enumerate(zip(axes, panels, strict=True)):
            ax.imshow(panel, **image, **(error if i == 2 else distance))
            if seen is not None:
                ax.imshow(np.where(seen, np.nan, 0.78), **image, cmap="gray", vmin=0, vmax=1)
            if i == 0 and mesh is not None:
                ax.add_collection(_section(mesh, height))
            else:  # the error's panel shows the true surfaces
                _draw_zeros(ax, x, y, panels[min(i, 1)], seen if i == 0 else None)
            if path_world is not None:
                path_xy = np.asarray(path_world, float)[:, :2]
                ax.plot(*path_xy.T, color="tab:green", linewidth=1.2)
                ax.plot(*path_xy[0], "o", color="tab:green", markersize=4)
            ax.set_title(f"{titles[i]}, z = {height:.2f} m", fontsize=11)
            ax.set(xlim=box[:, 0], ylim=box[:, 1])
        axes[0].set_ylabel("y [m]")
    for ax in grid[-1]:
        ax.set_xlabel("x [m]")
    bar = {"location": "bottom", "extend": "both", "fraction": 0.05, "shrink": 0.7, "aspect": 40}
    values = grid[0, 0].images[0]
    figure.colorbar(values, ax=grid[:, :2], label="signed distance [m]", **bar)
    if truth_sdf is not None:
        bar |= {"aspect": 20}
        figure.colorbar(grid[0, 2].images[0], ax=grid[:, 2], label="error [cm]", **bar)
    notes = ["black: surface"]
    notes += ["gray: not observed"] if observed is not None else []
    notes += ["green: path of the sensor, from the dot"] if path_world is not None else []
    figure.supxlabel("; ".join(notes), fontsize=9)
    with replacing(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:] or "png", dpi=110)


def _section(mesh: trimesh.Trimesh, height: float) -> LineCollection:
    """Cuts a mesh at a height, m."""
    from matplotlib.collections import LineCollection
    from trimesh.intersections import mesh_plane

    lines = mesh_plane(mesh, plane_normal=[0, 0, 1], plane_origin=[0, 0, height])
    return LineCollection([line[:, :2] for line in lines], colors="black", linewidths=1.0)


def _draw_zeros(
    ax: Axes, x: np.ndarray, y: np.ndarray, distances: np.ndarray, seen: np.ndarray | None
) -> None:
    """Draws where distances are zero, in space that was seen or near it."""
    from scipy.ndimage import maximum_filter

    # An unsigned distance never crosses zero: a level close to it replaces zero.
    level = 0.0 if np.nanmin(distances) < 0 else x[1] - x[0]
    if seen is not None:
        # Zeros far from observed space are guesses of the map, not surfaces.
        samples = math.ceil(_SURFACE_REACH / (x[1] - x[0]))
        distances = np.where(maximum_filter(seen, 2 * samples + 1), distances, np.nan)
    finite = distances[np.isfinite(distances)]
    if finite.size and finite.min() < level < finite.max():
        ax.contour(x, y, distances, levels=[level], colors="black", linewidths=1.0)


def _axes(box: np.ndarray) -> list[np.ndarray]:
    """The centers of a grid of square cells over x and y."""
    span = box[1, :2] - box[0, :2]
    counts = np.maximum(np.rint(_COLUMNS * span / span.max()), 2).astype(int)
    return [
        low + (np.arange(count) + 0.5) * (extent / count)
        for low, extent, count in zip(box[0, :2], span, counts, strict=True)
    ]


def _sample(function: Callable[[np.ndarray], Any], points: np.ndarray, name: str) -> np.ndarray:
    """Evaluates a function at (H, W, 3) points in chunks of one shape; returns (H, W) floats."""
    flat = points.reshape(-1, 3).astype(np.float32)
    values = np.empty(len(flat))
    fill_in_chunks(lambda rows: (function(flat[rows]),), {name: values}, CHUNK)
    return values.reshape(points.shape[:2])
