"""A tree of frames whose edges move, as ROS's tf has it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.trajectory import Trajectory, pose_at

_MAX_GAP = 1.0  # s; corrections of a map's frame may come that seldom


class Edge(NamedTuple):
    """How a frame lies in its parent's.

    Attributes:
        parent: The parent frame's name.
        motion: T_parent_child over time; one pose if it is fixed.
        fixed: The pose holds for all times.
    """

    parent: str
    motion: Trajectory
    fixed: bool


def path_up(edges: dict[str, Edge], frame: str, top: str | None = None) -> list[str]:
    """Lists the frames from one up to the root of its tree.

    Args:
        edges: By the child's name.
        frame: Where to begin.
        top: Where to end; by default at the root.

    Returns:
        Names, `frame` first, the top last.

    Raises:
        ValueError: Top is not above the frame, or the frames go round in a circle.
    """
    path = [frame]
    while path[-1] != top and path[-1] in edges:
        parent = edges[path[-1]].parent
        if parent in path:
            raise ValueError(f"frames go round in a circle: {[*path, parent]}")
        path.append(parent)
    if top is not None and path[-1] != top:
        raise ValueError(f"frame {top!r} is not above {frame!r}, which has above it: {path[1:]}")
    return path


def transform_up(edges: dict[str, Edge], path: list[str], stamp: float) -> np.ndarray:
    """Composes the transforms along a path at one time.

    Args:
        edges: By the child's name.
        path: From `path_up`.
        stamp: s.

    Returns:
        (4, 4) float64, T_top_frame.

    Raises:
        ValueError: There is no transform for this time.
    """
    pose = np.eye(4)
    for child in path[:-1]:
        edge = edges[child]
        when = float(edge.motion.stamps[0]) if edge.fixed else stamp
        pose = pose_at(edge.motion, when, _MAX_GAP) @ pose
    return pose
