"""Values as colors that color-blind people can tell apart, and the bars that explain them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

UNSEEN = (150, 150, 150)
"""Color of unseen space, 0..255."""

_BAR_INCHES = (3.2, 0.62)  # of one bar, with its label and numbers
_DPI = 150


@dataclasses.dataclass(frozen=True)
class Scale:
    """A scale of colors.

    Attributes:
        label: What the values are, with their unit in brackets.
        palette: Name of a colormap of matplotlib.
        low: Value at its low end.
        high: Value at its high end.
    """

    label: str
    palette: str
    low: float
    high: float

    def paint(self, values: np.ndarray) -> np.ndarray:
        """Colors (..., 3) uint8 of values (...); gray where they are not finite."""
        from matplotlib import colormaps

        values = np.asarray(values, float)
        share = (values - self.low) / max(self.high - self.low, 1e-9)
        known = np.isfinite(share)
        colors = np.asarray(colormaps[self.palette](np.where(known, share, 0.0), bytes=True))[
            ..., :3
        ]
        return np.where(known[..., None], colors, np.array(UNSEEN, np.uint8))


# The same distances have the same colors in every map, and whatever else is in the picture.
DISTANCE = Scale("signed distance [m]", "RdBu", -1.0, 1.0)
CLEARANCE = Scale("clearance of the robot's spheres [m]", "PuOr", -0.3, 0.3)


def height_scale(heights: np.ndarray) -> Scale:
    """A scale for heights, m, in whole decimeters, that a few specks do not stretch."""
    low, high = np.percentile(heights, [1, 99]) if len(heights) else (0.0, 1.0)
    low, high = math.floor(10 * low) / 10, math.ceil(10 * high) / 10
    return Scale("height of the surface [m]", "viridis_r", low, max(high, low + 0.1))


def spread_scale() -> Scale:
    """The scale for the spread of the hits, in cm."""
    return Scale("spread of the hits [cm]", "viridis_r", 0.0, 3.0)


def error_scale() -> Scale:
    """The scale for errors of the surface, in cm; positive in front of the true one."""
    return Scale("error of the surface [cm]", "PuOr_r", -5.0, 5.0)


def to_linear(colors: np.ndarray) -> np.ndarray:
    """Converts colors for a screen, uint8 sRGB, to those of glTF's vertices, uint8 linear."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * linear).astype(np.uint8)


def draw_bars(scales: Sequence[Scale], notes: Sequence[str] = ()) -> np.ndarray:
    """Draws one bar for each scale, with its unit.

    Args:
        scales: The scales, from top to bottom.
        notes: Lines of text below them.

    Returns:
        The picture, (H, W, 3) uint8, on white.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    width, bar_height = _BAR_INCHES
    height = bar_height * len(scales) + 0.16 * len(notes) + 0.06
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    for i, scale in enumerate(scales):
        bottom = (height - 0.06 - bar_height * i - 0.18) / height
        axes = figure.add_axes((0.05, bottom, 0.9, 0.15 / height))
        colors = ScalarMappable(Normalize(scale.low, scale.high), colormaps[scale.palette])
        ticks = MaxNLocator(5)
        bar = figure.colorbar(colors, cax=axes, orientation="horizontal", ticks=ticks)
        bar.set_label(scale.label, fontsize=9, labelpad=1)
        bar.ax.tick_params(labelsize=8, pad=1)
    for i, note in enumerate(notes):
        y = (0.05 + 0.16 * (len(notes) - 1 - i)) / height
        figure.text(0.05, y, note, fontsize=8, color="0.25")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
