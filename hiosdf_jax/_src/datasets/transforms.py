"""A tree of coordinate frames whose edges move, like ROS's tf."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.timed_poses import TimedPoses, pose_at

_MAX_GAP = 1.0  # s; a localization may correct the map frame this rarely
_STILL = 1e-6  # m, and of a quaternion; publishers repeat a pose to the last digit


class Edge(NamedTuple):
    """The pose of a frame in its parent.

    Attributes:
        parent: Name of the parent frame.
        motion: T_parent_child over time; a single pose if the edge is fixed.
        fixed: The pose holds at all times.
    """

    parent: str
    motion: TimedPoses
    fixed: bool


def path_up(edges: dict[str, Edge], frame: str, top: str | None = None) -> list[str]:
    """Lists the frames from one up to the root of its tree.

    Args:
        edges: The edge above each frame, by the frame's name.
        frame: Where to start.
        top: Where to stop; by default the root.

    Returns:
        Names, `frame` first, the top last.

    Raises:
        ValueError: Top is not above the frame, or the frames form a cycle.
    """
    path = [frame]
    while path[-1] != top and path[-1] in edges:
        parent = edges[path[-1]].parent
        if parent in path:
            source = edges[path[-1]].motion.source
            raise ValueError(f"{source}: frames form a cycle: {[*path, parent]}, expected a tree")
        path.append(parent)
    if top is not None and path[-1] != top:
        source = f"{edges[frame].motion.source}: " if frame in edges else ""
        raise ValueError(
            f"{source}frame {top!r} is not above {frame!r}, expected one of {path[1:]}"
        )
    return path


def moving(edges: dict[str, Edge], path: list[str]) -> list[str]:
    """Lists the frames of a path that move in their parents.

    An edge that publishes one pose again and again does not move.

    Args:
        edges: The edge above each frame, by the frame's name.
        path: From `path_up`.

    Returns:
        Names, without the top.
    """
    return [child for child in path[:-1] if not edges[child].fixed and moves(edges[child].motion)]


def moves(motion: TimedPoses) -> bool:
    """Returns whether poses differ; those that are not finite do."""
    # A quaternion and its negative are one rotation.
    with np.errstate(invalid="ignore"):
        signs = np.where(motion.quaternions @ motion.quaternions[0] < 0, -1, 1)
        poses = np.hstack([motion.positions, signs[:, None] * motion.quaternions])
        return not (np.abs(poses - poses[0]) <= _STILL).all()


def transform_up(edges: dict[str, Edge], path: list[str], stamp: float) -> np.ndarray:
    """Composes the transforms along a path at one time.

    Args:
        edges: The edge above each frame, by the frame's name.
        path: From `path_up`.
        stamp: s.

    Returns:
        (4, 4) float64, T_top_frame.

    Raises:
        ValueError: A moving edge has no pose for this time.
    """
    pose = np.eye(4)
    for child in path[:-1]:
        edge = edges[child]
        when = float(edge.motion.stamps[0]) if edge.fixed else stamp
        pose = pose_at(edge.motion, when, _MAX_GAP) @ pose
    return pose
