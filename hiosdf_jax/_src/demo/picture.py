"""Pictures of an exploring robot: what it knew, its planned path, and its clearance."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.demo.apartment import BOUNDS_WORLD
from hiosdf_jax._src.demo.exploration import ROBOT, Decision, Run
from hiosdf_jax._src.output_files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LIMIT = 0.6  # m, end of the color scale
_GIF_FRAMES = 60
_GIF_INCHES, _GIF_DPI = (7.0, 5.9), 80
_GIF_FRAME_MS, _GIF_LAST_MS = 150, 2500


def write_run(folder: Path, run: Run) -> None:
    """Writes `metrics.json`, `plan.png` and `plan.gif`.

    Args:
        folder: An existing folder.
        run: The run.

    Raises:
        OSError: A file cannot be written.
    """
    save_picture(folder / "plan.png", run)
    save_animation(folder / "plan.gif", run)
    with replacing(folder / "metrics.json") as file:
        file.write((json.dumps(run.metrics, indent=2) + "\n").encode())


def save_picture(path: str | os.PathLike[str], run: Run) -> None:
    """Draws three decisions of a run and its clearance over time.

    Args:
        path: The picture; its suffix names the format.
        run: The run.
    """
    from matplotlib.figure import Figure  # without pyplot: Agg, independent of the user's backend

    figure = Figure(figsize=(17, 8.6), layout="constrained")
    rows: Any = figure.subfigures(2, 1, height_ratios=(1.75, 1))
    driving = [decision for decision in run.decisions if not decision.turning] or run.decisions
    shown = [driving[0], driving[len(driving) // 2], run.decisions[-1]]
    panels = rows[0].subplots(1, len(shown), sharey=True)
    titles = ("after looking around", "half-way", "in the end")
    for ax, decision, title in zip(panels, shown, titles, strict=True):
        image = _draw_decision(ax, run, decision)
        ax.set_title(f"{title}: {decision.step * ROBOT.step:.0f} s", fontsize=12)
        ax.set_xlabel("x [m]")
    panels[0].set_ylabel("y [m]")
    rows[0].colorbar(
        image, ax=list(panels), label="distance of the body's axis [m]", shrink=0.9, extend="both"
    )
    rows[0].supxlabel(
        "gray: not seen; dull: not seen at all heights of the body; black: surfaces in the map; "
        "green: driven; magenta: planned path; orange: rollouts; star: goal",
        fontsize=10,
    )
    _draw_clearance(rows[1].subplots(), run)
    with replacing(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:] or "png", dpi=80)


def save_animation(path: str | os.PathLike[str], run: Run) -> None:
    """Draws the run as an animated GIF.

    Args:
        path: The file.
        run: The run.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    every = -(-len(run.decisions) // _GIF_FRAMES)
    decisions = run.decisions[::every]
    if decisions[-1] is not run.decisions[-1]:
        decisions.append(run.decisions[-1])
    figure = Figure(figsize=_GIF_INCHES, dpi=_GIF_DPI)
    canvas = FigureCanvasAgg(figure)
    frames = []
    for decision in decisions:
        figure.clear()
        ax = figure.add_axes((0.05, 0.04, 0.93, 0.91))
        _draw_decision(ax, run, decision)
        ax.set_title(
            f"{decision.step * ROBOT.step:5.1f} s, clearance in the map "
            f"{100 * run.clearance[decision.step]:3.0f} cm, exact "
            f"{100 * run.exact_clearance[decision.step]:3.0f} cm",
            fontsize=10,
        )
        canvas.draw()
        pixels = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
        # An octree keeps the few pixels of goal and path red; a median cut does not.
        frames.append(pixels.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    durations = [_GIF_FRAME_MS] * (len(frames) - 1) + [_GIF_LAST_MS]
    animation = {"save_all": True, "append_images": frames[1:], "duration": durations, "loop": 0}
    with replacing(path) as file:
        frames[0].save(file, format="GIF", **animation)


def _draw_decision(ax: Axes, run: Run, decision: Decision) -> Any:
    """Draws what the robot knew, seen from above; returns the image of distances."""
    from matplotlib.patches import Circle

    (x0, y0, _), (x1, y1, _) = BOUNDS_WORLD
    extent = (x0, x1, y0, y1)
    gap = decision.cells.gap
    distance = np.where(np.isfinite(gap), gap + ROBOT.radius, np.nan).T
    ax.set_facecolor("0.75")
    image = ax.imshow(
        distance, extent=extent, origin="lower", cmap="RdBu", vmin=-_LIMIT, vmax=_LIMIT
    )
    # Cells seen at some heights only: the body may not enter them yet.
    veil = np.where(decision.cells.seen.T | ~np.isfinite(distance), np.nan, 0.75)
    ax.imshow(veil, extent=extent, origin="lower", cmap="gray", vmin=0, vmax=1, alpha=0.45)
    x, y = (axis[:, 0] for axis in (run.floor.centers()[..., 0], run.floor.centers()[..., 1].T))
    if np.nanmin(distance) < 0 < np.nanmax(distance):
        ax.contour(x, y, np.nan_to_num(distance, nan=1.0), levels=[0], colors="k", linewidths=1)
    for rollout in decision.rollouts:
        ax.plot(*rollout.T, color="tab:orange", linewidth=0.5, alpha=0.7)
    ax.plot(*decision.path.T, color="magenta", linewidth=1.2, linestyle=":")
    ax.plot(*run.states[: decision.step + 1, :2].T, color="tab:green", linewidth=1.8)
    ax.plot(*run.problem.start[:2], "o", color="tab:green", markersize=4)
    ax.plot(*run.problem.goal, "*", color="red", markersize=12, markeredgecolor="k")
    px, py, yaw = run.states[decision.step, :3]
    ax.add_patch(Circle((px, py), ROBOT.radius, facecolor="white", edgecolor="k", zorder=3))
    nose = ROBOT.radius * np.array([np.cos(yaw), np.sin(yaw)])
    ax.plot([px, px + nose[0]], [py, py + nose[1]], color="k", linewidth=2, zorder=4)
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    return image


def _draw_clearance(ax: Axes, run: Run) -> None:
    seconds = ROBOT.step * np.arange(len(run.states))
    ax.plot(seconds, 100 * run.exact_clearance, color="k", label="exact")
    label = "in the map, unseen space solid"
    ax.plot(seconds, 100 * run.clearance, color="tab:blue", linewidth=1, label=label)
    ax.axhline(100 * ROBOT.margin, color="tab:orange", linestyle="--", label="the guard's margin")
    ax.axhline(0, color="tab:red", label="collision")
    stops = [decision.step for decision in run.decisions if decision.turning]
    for step in stops:
        ax.axvspan(*(ROBOT.step * np.array([step, step + 2])), color="0.9", linewidth=0, zorder=0)
    floor_cm = 100 * (ROBOT.heights[0] - ROBOT.radius)
    outcome = "reached" if run.metrics["reached"] else "not reached"
    ax.set(
        xlabel="time [s] (on gray: turning to look around)",
        ylabel=f"clearance of the body [cm]\n(floor: {floor_cm:.0f})",
        xlim=(0, max(float(seconds[-1]), 1.0)),
        ylim=(min(-1.0, 110 * float(run.exact_clearance.min())), 22),
        title=f"{run.metrics['from']} to {run.metrics['to']}: {outcome} after "
        f"{run.metrics['robot_s']:.0f} s and {run.metrics['path_m']:.1f} m, "
        f"least clearance {100 * run.metrics['least_clearance_m']:.1f} cm",
    )
    ax.legend(loc="upper right", ncols=4, fontsize=9)
