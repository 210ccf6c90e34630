"""Which transforms of a ROS bag move its sensor: those of tf, or those of an odometry topic."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hiosdf_jax._src.datasets.stream import NoPosesError
from hiosdf_jax._src.datasets.timed_poses import TimedPoses, check_unique
from hiosdf_jax._src.datasets.transforms import Edge, moves, moving, path_up

Row = tuple[float, Any, Any]
"""Stamp, translation, rotation."""

Transform = tuple[str, str, bool, Row]
"""Child, parent, whether it holds at all times, and the pose."""


def find_tree(
    path: Path,
    transforms: list[Transform],
    odometry: dict[str, list[Transform]],
    sensor: str,
    odometry_topic: str | None,
    world_frame: str | None,
) -> tuple[dict[str, Edge], list[str]]:
    """Finds the transforms that lead from the sensor up to the map.

    Args:
        path: The bag, for messages.
        transforms: Those of tf.
        odometry: The transforms of each odometry topic.
        sensor: The frame of the clouds.
        odometry_topic: The topic that replaces tf for its child frame; None to choose.
        world_frame: The frame of the map; None for the root.

    Returns:
        The edge above each frame, and the path from the sensor up to the map.

    Raises:
        NoPosesError: Nothing moves the sensor.
        ValueError: A name is wrong, tf and odometry may both be the motion of the sensor, or a
            transform has two poses at one time.
    """
    if world_frame is not None and not isinstance(world_frame, str):
        raise ValueError(f"{path}: world_frame is {world_frame!r}, expected a frame's name")
    world_frame = None if world_frame is None else frame_name(world_frame)
    edges = _edges(path, transforms)
    if odometry_topic is None:
        odometry_topic = _default_odometry(path, edges, odometry, sensor, world_frame)
    if odometry_topic is not None:
        edges |= _odometry_edges(path, edges, odometry, sensor, odometry_topic)
    to_root = path_up(edges, sensor)
    if world_frame is not None:
        _check_world_frame(path, edges, to_root, world_frame)
    elif odometry_topic is None and not moving(edges, to_root):  # odometry may well stand still
        raise NoPosesError(
            f"{path}: nothing moves above the cloud's frame, {' in '.join(to_root)}; expected tf, "
            f"or one of the odometry topics {sorted(odometry)} whose child is one of these frames, "
            "or a world_frame if the sensor stands still"
        )
    return edges, unique_path_up(edges, sensor, world_frame)


def _edges(path: Path, transforms: Iterable[Transform]) -> dict[str, Edge]:
    """Groups transforms by child frame; motion takes precedence over a fixed transform."""
    rows: dict[tuple[str, bool], list[Row]] = defaultdict(list)
    parents: dict[tuple[str, bool], str] = {}
    for child, parent, fixed, row in transforms:
        known = parents.setdefault((child, fixed), parent)
        if known != parent:
            raise ValueError(f"{path}: frame {child!r} has two parents, {known!r} and {parent!r}")
        rows[child, fixed].append(row)
    edges = {}
    for (child, fixed), parent in sorted(parents.items(), key=lambda item: not item[0][1]):
        table = rows[child, fixed]
        motion = _timed(table[-1:] if fixed else table, f"{path}, {child} in {parent}")
        edges[child] = Edge(parent, motion, fixed)
    return edges


def _timed(rows: list[Row], source: str) -> TimedPoses:
    """Sorts poses by time."""
    rows = sorted(rows, key=lambda row: row[0])
    return TimedPoses(
        stamps=np.array([stamp for stamp, _, _ in rows]),
        positions=np.array([(p.x, p.y, p.z) for _, p, _ in rows]),
        quaternions=np.array([(q.x, q.y, q.z, q.w) for _, _, q in rows]),
        source=source,
    )


def _odometry_edges(
    path: Path,
    edges: dict[str, Edge],
    odometry: dict[str, list[Transform]],
    sensor: str,
    topic: str,
) -> dict[str, Edge]:
    """Returns the edges of an odometry topic, one of them above the sensor."""
    if topic not in odometry:
        raise ValueError(f"{path}: odometry_topic = {topic!r}, expected one of {sorted(odometry)}")
    moved = _edges(path, odometry[topic])
    above = path_up(edges | moved, sensor)
    if moved.keys().isdisjoint(above):
        raise ValueError(
            f"{path}: odometry topic {topic} moves {list(moved)}, expected one of {above}, the "
            "frames from the cloud's frame upward"
        )
    return moved


def _check_world_frame(
    path: Path, edges: dict[str, Edge], to_root: list[str], world_frame: str
) -> None:
    """Raises unless a frame can be that of the map, for a sensor with this path to the root."""
    if world_frame not in to_root:
        raise ValueError(
            f"{path}: frame {world_frame!r} is not above {to_root[0]!r}, expected one of "
            f"{to_root[1:]}"
        )
    if world_frame == to_root[0] and moving(edges, to_root):
        raise ValueError(
            f"{path}: world_frame = {world_frame!r}, which is the clouds' own and moves; expected "
            f"one of {to_root[1:]}"
        )


def unique_path_up(edges: dict[str, Edge], frame: str, top: str | None) -> list[str]:
    """Calls `path_up`, and checks that no edge on the path has two poses at one time."""
    path = path_up(edges, frame, top)
    for child in path[:-1]:
        if not edges[child].fixed:
            check_unique(edges[child].motion)
    return path


def _default_odometry(
    path: Path,
    edges: dict[str, Edge],
    odometry: dict[str, list[Transform]],
    sensor: str,
    world_frame: str | None,
) -> str | None:
    """Returns the odometry topic that has the motion of the sensor, None if tf has it."""
    joints = moving(edges, path_up(edges, sensor))
    if not joints:
        topics = [topic for topic, rows in odometry.items() if rows[0][0] in path_up(edges, sensor)]
        return topics[0] if len(topics) == len(odometry) == 1 else None
    rivals = [
        topic
        for topic, rows in odometry.items()
        if moves(_timed([row for *_, row in rows], f"{path}, {topic}"))
    ]
    known = [_tf_has(edges, sensor, *odometry[topic][0][:2]) for topic in rivals]
    if not rivals or True in known:
        return None
    if known == [False] and not _only_tf_has(edges, odometry[rivals[0]], sensor, world_frame, path):
        return rivals[0]
    if world_frame is not None:
        return None
    raise ValueError(
        f"{path}: tf moves {joints}, and odometry topics {rivals} move "
        f"{[odometry[topic][0][0] for topic in rivals]}; expected odometry_topic= or world_frame= "
        "to choose odometry or tf as the motion of the sensor"
    )


def _only_tf_has(
    edges: dict[str, Edge],
    rows: list[Transform],
    sensor: str,
    world_frame: str | None,
    path: Path,
) -> bool:
    """Returns whether a frame is above the sensor in tf, and not with an odometry laid over it."""
    above = path_up(edges | _edges(path, rows), sensor)
    return world_frame in path_up(edges, sensor) and world_frame not in above


def _tf_has(edges: dict[str, Edge], sensor: str, child: str, parent: str) -> bool | None:
    """Returns whether tf has the motion of an odometry's child in its parent; None if unknown.

    What moves between the sensor and the child is a joint, such as that of a turning mount.
    """
    above, over_child = path_up(edges, sensor), path_up(edges, child)
    if child in above:
        return bool(moving(edges, over_child))
    if over_child[-1] == above[-1]:
        return True if moving(edges, over_child) else None
    if parent in above:
        return bool(moving(edges, path_up(edges, sensor, parent)))
    return None


def frame_name(frame: str) -> str:
    return frame.lstrip("/")  # old tf wrote names with a leading slash
