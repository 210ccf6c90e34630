"""The surface of a map as `.ply`, and as `.glb` for browsers, Blender and game engines."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.view import scene

if TYPE_CHECKING:
    import trimesh

# glTF's y points up, and its x to the right as ours: (x, y, z) becomes (x, z, -y).
_GLTF_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def write_ply(path: str | os.PathLike[str], mesh: trimesh.Trimesh) -> None:
    """Writes a mesh, in the world frame, with its normals and the spread of its hits.

    Args:
        path: The file.
        mesh: From `hiosdf_jax.extract_mesh`.

    Raises:
        OSError: The file cannot be written.
    """
    with replacing(path) as file:
        mesh.export(file, file_type="ply")


def write_glb(path: str | os.PathLike[str], mesh: trimesh.Trimesh) -> None:
    """Writes a mesh, colored by height, as glTF stands: with y up.

    Args:
        path: The file.
        mesh: From `hiosdf_jax.extract_mesh`, with faces.

    Raises:
        OSError: The file cannot be written.
    """
    painted, _ = scene.paint_surface(mesh, "height")
    vertices, normals = (
        np.asarray(each) @ _GLTF_FROM_WORLD.T for each in (mesh.vertices, mesh.vertex_normals)
    )
    with replacing(path) as file:
        file.write(scene.as_glb(vertices, normals, np.asarray(mesh.faces), painted))
