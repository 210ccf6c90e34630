"""What a finished map looks like: level slices of its distances, and its surface as a mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from hiosdf_jax._src.field import mesh
from hiosdf_jax._src.field.points import query, sdf
from hiosdf_jax._src.state import Field

if TYPE_CHECKING:
    import trimesh

# A mesh is sampled about this often, within limits: no finer than anyone can see, no coarser than
# the grid.
_MESH_SAMPLES = 4e6
_MESH_FINEST = 0.025  # m
_SMOOTHINGS = 20  # of the mesh, for its picture

_LEVEL = np.radians(10)  # a normal nearer than this to upwards is that of a floor or a table
_TILTED = np.radians(2)  # a world whose z is farther than this from upwards is levelled to draw it
_MARGIN = 0.2  # m, around what is drawn of it
_HEADROOM = 2.5  # m above the sensor; rooms are lower, and have little to show up there


def draw_map(
    folder: Path,
    field: Field,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
    path_world: np.ndarray,
    up_world: np.ndarray,
) -> np.ndarray:
    """Writes `slices.png`, `mesh.ply` and `mesh.png`.

    Args:
        folder: Where to.
        field: The map.
        exact_sdf: Maps (n, 3) points in the world, m, to (n,) exact distances, m; drawn beside the
            map.
        path_world: (F, 3) m, the sensor's positions.
        up_world: (3,) unit vector against gravity, a first guess.

    Returns:
        The direction against gravity that they are drawn by, from floors and tables.
    """
    surface = _extract(field)
    up_world = level_up(surface, up_world)
    _write_mesh(folder, surface, up_world)
    _draw_slices(folder / "slices.png", field, exact_sdf, path_world, surface, up_world)
    return up_world


def slice_heights(sensor: float, low: float, high: float) -> list[float]:
    """Chooses where to cut a map: at the sensor's height, half-way down, and in halls half-way up.

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
        surface: With normals towards free space.
        up_world: (3,) unit vector, a first guess.

    Returns:
        (3,) unit vector; the guess where nothing about level is to be seen.
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
    field: Field,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
    path_world: np.ndarray,
    surface: trimesh.Trimesh,
    up_world: np.ndarray,
) -> None:
    """Draws level slices: in the world, or if that is tilted in a frame turned to be upright."""
    from hiosdf_jax import view

    bounds: Sequence[Sequence[float]] = field.config.bounds
    tilted = up_world[2] < np.cos(_TILTED)
    world_from_level = _turn_to(up_world) if tilted else np.eye(3)
    path = path_world @ world_from_level
    solid = np.asarray(surface.vertices if len(surface.faces) else bounds) @ world_from_level
    if tilted:
        print("the world's z is not upwards: slices.png is in a frame turned to be level")
        corners = np.concatenate([solid, path])
        bounds = np.stack([corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN]).tolist()
    low, high = np.percentile(solid[:, 2], [2, 98])  # floor and ceiling, but for specks
    turn = world_from_level.T.astype(np.float32)  # of rows
    view.save_slices(
        file,
        lambda points: sdf(field, points @ turn),
        None if exact_sdf is None else lambda points: exact_sdf(points @ turn),
        bounds,
        slice_heights(float(np.median(path[:, 2])), float(low), float(high)),
        path_world=path,
        observed=lambda points: _observed(field, points @ turn),
    )


def _turn_to(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes z to a unit vector, (3, 3)."""
    if up[2] < -1 + 1e-6:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    skew = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + z)


def _extract(field: Field) -> trimesh.Trimesh:
    low, high = np.asarray(field.config.bounds)
    spacing = max(float(np.cbrt(np.prod(high - low) / _MESH_SAMPLES)), _MESH_FINEST)
    return mesh.extract_mesh(field, min(spacing, field.config.voxel_size))


def _write_mesh(folder: Path, surface: trimesh.Trimesh, up_world: np.ndarray) -> None:
    from hiosdf_jax import view

    model, picture = folder / "mesh.ply", folder / "mesh.png"
    if not len(surface.faces):
        print("the map shows no surface: no mesh.ply, no mesh.png")
        for path in (model, picture):  # of an earlier run
            path.unlink(missing_ok=True)
        return
    surface.export(model)
    from trimesh.smoothing import filter_taubin

    # For the eye only: between patches the surface has steps of some millimetres.
    smooth = filter_taubin(surface.copy(), iterations=_SMOOTHINGS)
    view.save_shaded(picture, smooth, up_world=up_world.tolist())


# The map is an argument, so that this compiles once for maps of one configuration.
_observed = jax.jit(lambda field, points: query(field, points).observed)
