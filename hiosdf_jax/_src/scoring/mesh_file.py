"""Reads untrusted mesh files: sizes are checked before memory is taken, indices before use.

Foreign code, in C++ too, indexes corners by the file's numbers without checking them.
"""

from __future__ import annotations

import io
import json
import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.datasets.clouds import ply_counts
from hiosdf_jax._src.datasets.files import most_returns, open_regular, parsing
from hiosdf_jax._src.numerics.rigid import FARTHEST_M

if TYPE_CHECKING:
    import trimesh

# Text or arrays that are as large in memory as in the file. Archives such as .3mf are not among
# them, and formats that name other files lose those: nothing but the file itself is opened.
_FORMATS = (".ply", ".obj", ".stl", ".off", ".glb")


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """Reads a mesh file.

    Args:
        path: A `.ply`, `.obj`, `.stl`, `.off` or `.glb` file, m.

    Returns:
        The mesh, without colors and materials; corners at the same place are one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not such a file, has no triangle, or a corner that is not finite or is not
            there. The message names the file.
    """
    import trimesh

    path = Path(path)
    kind = path.suffix.lower()
    with open_regular(path) as file:
        if kind not in _FORMATS:
            raise ValueError(f"{path}: no mesh, expected one of {', '.join(_FORMATS)}")
        with parsing(path, "mesh"):
            # From memory: a reader asks a file for as many bytes as a part of it declares.
            content = io.BytesIO(file.read())
            if kind == ".ply":
                ply_counts(content)
            elif kind == ".glb":
                _check_glb(content.getvalue())
            extra = {"skip_materials": True} if kind in (".obj", ".glb") else {}
            # Without processing, which follows the indices.
            raw = trimesh.load_mesh(content, kind.removeprefix("."), process=False, **extra)
            vertices, faces = corners_and_faces(raw)
            return trimesh.Trimesh(vertices, faces)


def corners_and_faces(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checks a mesh of trimesh.

    Args:
        mesh: The mesh, m.

    Returns:
        Its corners (V, 3) float64 and triangles (T, 3) int64, copied.

    Raises:
        ValueError: It has no triangles, or corners that are not there, not finite or more than
            100 km away.
    """
    vertices, faces = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
    if not len(faces):
        raise ValueError("the mesh has 0 triangles, expected at least 1")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"the mesh has corners of shape {vertices.shape}, expected (V, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"the mesh has triangles of shape {faces.shape}, expected (T, 3)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"the mesh has triangles with corners {faces.min()} to {faces.max()}, expected 0 to "
            f"{len(vertices) - 1}"
        )
    if not np.isfinite(vertices).all():
        raise ValueError("the mesh has corners that are not finite, expected m")
    if np.abs(vertices).max() > FARTHEST_M:
        raise ValueError(
            f"the mesh has corners {np.abs(vertices).max():.3g} m away, expected at most "
            f"{FARTHEST_M:g}"
        )
    return vertices, faces


def _check_glb(content: bytes) -> None:
    """Compares what a GLB file declares with its size."""
    (size,) = struct.unpack("<I", content[12:16])
    header = json.loads(content[20 : 20 + size])
    counts = [accessor["count"] for accessor in header.get("accessors", [])]
    if not all(type(count) is int and 0 <= count <= len(content) for count in counts):
        raise ValueError(f"it declares arrays of {counts} in {len(content)} bytes")
    nodes = header.get("nodes", [])
    children = [child for node in nodes for child in node.get("children", [])]
    roots = [root for each in header.get("scenes", []) for root in each.get("nodes", [])]
    if len(set(children)) < len(children) or set(children) & set(roots):
        raise ValueError("a node has two parents")  # nodes within nodes would double each time
    corners = [
        sum(
            counts[index]
            for part in mesh["primitives"]
            for index in (part.get("indices"), part["attributes"].get("POSITION"))
            if index is not None
        )
        for mesh in header.get("meshes", [])
    ]
    total = sum(corners[node["mesh"]] for node in nodes if "mesh" in node)
    most = most_returns(len(content))
    if total > most:
        raise ValueError(f"its nodes have {total} corners, expected at most {most}")
