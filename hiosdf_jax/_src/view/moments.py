"""The moments of a growing map that a time slider goes back to."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax
import numpy as np

from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.state.pytrees import Field
from hiosdf_jax._src.view import scene

if TYPE_CHECKING:
    import trimesh

_MOST_MOMENTS = 60
_MOST_BYTES = 512 * 2**20


@dataclasses.dataclass(frozen=True)
class Moment:
    """A map at one time, and the sensor.

    Attributes:
        field: The snapshot.
        mesh: Its surface, with the largest triangles that `extract_mesh` makes.
        cloud_world: (n, 3) m, the newest cloud; empty if there is none.
        sensor_world: (L, 2, 3) m, lines that outline the sensor.
        path_world: (F, 3) m, where the sensor has been.
    """

    field: Field
    mesh: trimesh.Trimesh
    cloud_world: np.ndarray
    sensor_world: np.ndarray
    path_world: np.ndarray

    @property
    def updates(self) -> int:
        """Number of updates of the map."""
        return int(self.field.updates)

    @property
    def nbytes(self) -> int:
        """Memory that it takes, about."""
        leaves = (self.mesh.vertices, self.mesh.faces, *jax.tree.leaves(self.field))
        return sum(leaf.nbytes for leaf in leaves) + self.cloud_world.nbytes


def capture(
    field: Field,
    cloud: np.ndarray | None,
    pose: np.ndarray | None,
    path_world: np.ndarray,
) -> Moment:
    """Makes a moment.

    Args:
        field: A snapshot of the map.
        cloud: (N, 3) m, sensor frame; None if there is none.
        pose: (4, 4) T_world_sensor; None without a cloud.
        path_world: (F, 3) m, where the sensor has been.

    Returns:
        The moment.
    """
    cloud_world = np.empty((0, 3), np.float32)
    lines = np.empty((0, 2, 3), np.float32)
    if cloud is not None and pose is not None:
        cloud_world, lines = scene.thin_cloud(cloud, pose), scene.sensor_lines(cloud, pose)
    mesh = extract_mesh(field, field.config.voxel_size)
    return Moment(field, mesh, cloud_world, lines, np.asarray(path_world, np.float32))


def keep(moments: list[Moment], newest: Moment) -> list[Moment]:
    """Adds a moment; where they get too many, one goes whose neighbors are closest together.

    The first one and the newest one stay, so that what is left spans the whole run, about evenly.
    They take at most 512 MB, or are two.

    Args:
        moments: The moments so far, oldest first; not changed.
        newest: The new one.

    Returns:
        The moments to keep, oldest first.
    """
    kept = [*moments, newest]
    while len(kept) > 2 and (
        len(kept) > _MOST_MOMENTS or sum(each.nbytes for each in kept) > _MOST_BYTES
    ):
        updates = np.array([each.updates for each in kept])
        del kept[1 + int(np.argmin(updates[2:] - updates[:-2]))]
    return kept
