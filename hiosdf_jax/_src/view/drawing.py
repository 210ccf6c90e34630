"""Draws a finished map: horizontal slices of its distances, and its surface as a mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiosdf_jax._src.field import mesh
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.view.leveling import is_tilted, world_from_level
from hiosdf_jax._src.view.shading import save_shaded
from hiosdf_jax._src.view.slices import save_slices

if TYPE_CHECKING:
    import trimesh

_LEVEL = np.radians(10)  # floors and tables have normals within this angle of upward
_MARGIN = 0.2  # m, around a leveled world
_HEADROOM = 2.5  # m above the sensor; rooms are lower, and a slice up there shows little


def draw_map(
    folder: Path,
    queries: CompiledQueries,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
    path_world: np.ndarray,
    up_world: np.ndarray,
) -> np.ndarray:
    """Writes `slices.png`, `mesh.ply` and `mesh.png`.

    Args:
        folder: Where to write.
        queries: The queries of the map.
        exact_sdf: Maps (n, 3) points, m, world frame, to (n,) exact distances, m; drawn beside the
            map.
        path_world: (F, 3) m, the sensor's positions.
        up_world: (3,) unit vector against gravity, a first guess.

    Returns:
        (3,) unit vector against gravity, refined from floors and tables; the pictures use it.
    """
    surface = mesh.extract_mesh(queries.field, 0.5 * queries.field.config.voxel_size)
    up_world = level_up(surface, up_world)
    _write_mesh(folder, surface, up_world)
    _draw_slices(folder / "slices.png", queries, exact_sdf, path_world, surface, up_world)
    return up_world


def slice_heights(sensor: float, low: float, high: float) -> list[float]:
    """Chooses the heights of the slices: the sensor's, halfway down, and halfway up in halls.

    Args:
        sensor: Height of the sensor, m.
        low: Height of the floor, m.
        high: Height of the ceiling, m.

    Returns:
        One to three heights, m, ascending.
    """
    heights = [sensor]
    if sensor - low >= 0.4:
        heights.insert(0, (low + sensor) / 2)
    if high - sensor >= _HEADROOM:
        heights.append((sensor + high) / 2)
    return heights


def level_up(surface: trimesh.Trimesh, up_world: np.ndarray) -> np.ndarray:
    """Finds the direction against gravity from floors and tables.

    Args:
        surface: The mesh of the map, with normals toward free space.
        up_world: (3,) unit vector, a first guess.

    Returns:
        (3,) unit vector; the guess if no face is about level.
    """
    if not len(surface.faces):
        return up_world
    for within in (4 * _LEVEL, 2 * _LEVEL, _LEVEL):
        level = surface.face_normals @ up_world > np.cos(within)
        total = (surface.area_faces[level, None] * surface.face_normals[level]).sum(axis=0)
        if total.any():
            up_world = total / np.linalg.norm(total)
    return up_world


def _draw_slices(
    file: Path,
    queries: CompiledQueries,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
    path_world: np.ndarray,
    surface: trimesh.Trimesh,
    up_world: np.ndarray,
) -> None:
    """Draws horizontal slices, in the world frame or, if that is tilted, in a leveled one."""
    bounds: Sequence[Sequence[float]] = queries.field.config.bounds
    rotation = world_from_level(up_world)
    path = path_world @ rotation
    solid = np.asarray(surface.vertices if len(surface.faces) else bounds) @ rotation
    if is_tilted(up_world):
        print("the world's z does not point up: slices.png is drawn in a leveled frame")
        corners = np.concatenate([solid, path])
        bounds = np.stack([corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN]).tolist()
    low, high = np.percentile(solid[:, 2], [2, 98])  # floor and ceiling, without specks
    turn = rotation.T.astype(np.float32)  # acts on rows
    save_slices(
        file,
        lambda points: queries.sdf(points @ turn),
        None if exact_sdf is None else lambda points: exact_sdf(points @ turn),
        bounds,
        slice_heights(float(np.median(path[:, 2])), float(low), float(high)),
        path_world=path,
        observed=lambda points: queries.observed(points @ turn),
        mesh=_turned(surface, rotation),
    )


def _turned(surface: trimesh.Trimesh, rotation: np.ndarray) -> trimesh.Trimesh:
    """Turns a mesh into the frame of points @ rotation."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T
    return surface.copy().apply_transform(matrix)


def _write_mesh(folder: Path, surface: trimesh.Trimesh, up_world: np.ndarray) -> None:
    model, picture = folder / "mesh.ply", folder / "mesh.png"
    if not len(surface.faces):
        print("the map shows no surface: no mesh.ply, no mesh.png")
        return
    with replacing(model) as file:
        surface.export(file, file_type="ply")
    save_shaded(picture, surface, up_world=up_world.tolist())
