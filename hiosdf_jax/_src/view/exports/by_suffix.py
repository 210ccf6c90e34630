"""A map as a file of another program, by the suffix of the file's name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from hiosdf_jax._src.field.baking import bake
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.state.checks import as_live_field
from hiosdf_jax._src.state.pytrees import Field, MapState
from hiosdf_jax._src.view import moments, page, stage
from hiosdf_jax._src.view.exports import lattices, meshes, navigation, weights

SUFFIXES = {
    ".npz": "the field baked on a lattice, for numpy",
    ".vti": "the same for VTK and ParaView",
    ".pgm": "a costmap for ROS navigation, with its .yaml beside it",
    ".yaml": "the same",
    ".safetensors": "the weights of the network",
    ".ply": "the mesh",
    ".glb": "the mesh, colored, with y up",
    ".html": "the view, in one file; needs viser",
}
_LATTICES = (".npz", ".vti")
COSTMAPS = (".pgm", ".yaml")
_MESHES = (".ply", ".glb")


def export_map(
    path: str | os.PathLike[str],
    field: MapState | Field,
    resolution: float = 0.05,
    **robot: Any,
) -> None:
    """Writes a map as a file of another program; the suffix of the name selects the format.

    `.npz` and `.vti` have the baked field, `.pgm` or `.yaml` a costmap (both files are written),
    `.safetensors` the weights of the network, `.ply` and `.glb` the mesh, `.html` the view.

    Example:
        >>> exports.export_map("house.vti", state, resolution=0.1)
        >>> exports.export_map("house.yaml", state, floor_m=0.0, height_m=1.2, radius_m=0.3)

    Args:
        path: The file.
        field: A map, or a snapshot of one.
        resolution: Spacing of the samples, edge of a cell or of a triangle, m.
        **robot: For a costmap: `floor_m`, `height_m`, `radius_m` and `step_m`, see `costmap`.

    Raises:
        ValueError: The suffix is another, or an argument has a wrong type or value.
        OSError: The file cannot be written.
        ModuleNotFoundError: The format needs a package that is not installed.
    """
    suffix = check_suffix(path)
    field = as_live_field(field)
    if suffix in COSTMAPS:
        missing = {"floor_m", "height_m", "radius_m"} - robot.keys()
        if missing:
            raise ValueError(f"a costmap needs {', '.join(sorted(missing))}")
        grid = navigation.costmap(field, resolution=resolution, **robot)
        navigation.write_costmap(path, grid)
        return
    if robot:
        raise ValueError(f"{suffix} takes no {', '.join(sorted(robot))}: these are for a costmap")
    if suffix in _LATTICES:
        write = lattices.write_npz if suffix == ".npz" else lattices.write_vti
        write(path, bake(field, resolution))
    elif suffix in _MESHES:
        mesh = extract_mesh(field, resolution)
        if not len(mesh.faces):
            raise ValueError("the map shows no surface, expected one to write as a mesh")
        (meshes.write_ply if suffix == ".ply" else meshes.write_glb)(path, mesh)
    elif suffix == ".safetensors":
        weights.write_safetensors(path, field)
    else:
        page.write_page(path, [moments.capture(field, None, None, np.empty((0, 3)))], stage.Look())


def check_suffix(path: str | os.PathLike[str]) -> str:
    """Returns the suffix of a file that `export_map` can write, or raises a ValueError."""
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{os.fspath(path)}: expected a name with {', '.join(SUFFIXES)}")
    return suffix
