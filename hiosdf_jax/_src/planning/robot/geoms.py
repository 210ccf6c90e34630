"""The geoms of a MuJoCo model: which ones make up a robot, and a cover of each."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from hiosdf_jax._src.planning.robot import cover, solids


def compiled_model(model: Any) -> Any:
    """Reads the model of a file, or compiles that of a specification.

    Args:
        model: `mujoco.MjModel`, `mjx.Model`, `mujoco.MjSpec`, or the path of an XML file.

    Returns:
        A model with arrays of bodies and geoms.

    Raises:
        ValueError: It is none of these, or MuJoCo cannot read it.
    """
    if isinstance(model, str | os.PathLike):
        import mujoco

        return mujoco.MjModel.from_xml_path(os.fspath(model))
    if hasattr(model, "compile") and not hasattr(model, "nbody"):
        return model.compile()
    if not hasattr(model, "geom_bodyid"):
        raise ValueError(
            f"model is {type(model).__name__}, expected a MjModel, mjx.Model, MjSpec or a path"
        )
    return model


def chosen_geoms(model: Any, bodies: Any, geoms: Any) -> list[int]:
    """Lists the geoms that `spheres_from_model` covers.

    Args:
        model: A model.
        bodies: As for `spheres_from_model`.
        geoms: As for `spheres_from_model`.

    Returns:
        Their ids, in order.

    Raises:
        ValueError: Both are given, one is unknown, or no geom is chosen.
    """
    if bodies is not None and geoms is not None:
        raise ValueError("bodies and geoms are both given, expected at most one of them")
    if geoms is not None:
        chosen = _ids(model, geoms, "geom", model.ngeom)
    else:
        carriers = (
            _moving_bodies(model) if bodies is None else _ids(model, bodies, "body", model.nbody)
        )
        colliding = (np.asarray(model.geom_contype) != 0) | (
            np.asarray(model.geom_conaffinity) != 0
        )
        carried = np.isin(np.asarray(model.geom_bodyid), list(carriers))
        chosen = np.nonzero(colliding & carried)[0].tolist()
        _warn_of_bare_bodies(model, carried, chosen)
    if not chosen:
        raise ValueError("no geom is chosen, expected geoms, or bodies with colliding geoms")
    return sorted(set(chosen))


def _moving_bodies(model: Any) -> list[int]:
    """Lists the bodies that can move, or all but the world where none can."""
    moving = np.nonzero(np.asarray(model.body_weldid) != 0)[0].tolist()
    return moving or list(range(1, model.nbody))


def _warn_of_bare_bodies(model: Any, carried: np.ndarray, chosen: list[int]) -> None:
    bodies = np.asarray(model.geom_bodyid)
    bare = sorted(set(bodies[carried].tolist()) - set(bodies[chosen].tolist()))
    if bare and chosen:
        names = [_name(model, "body", body) for body in bare]
        warnings.warn(
            f"bodies {names} have geoms but none that collides, so that no sphere covers them: "
            f"choose geoms by geoms= if they should be covered",
            stacklevel=4,
        )


def _ids(model: Any, wanted: Any, kind: str, count: int) -> list[int]:
    if isinstance(wanted, str):
        raise ValueError(f"{kind} names are the string {wanted!r}, expected a list of names")
    names = [_name(model, kind, k) for k in range(count)]
    ids = []
    for item in wanted:
        if isinstance(item, str):
            if item not in names:
                raise ValueError(f"the model has no {kind} {item!r}, expected one of {names}")
            ids.append(names.index(item))
        elif 0 <= item < count:
            ids.append(int(item))
        else:
            raise ValueError(f"the model has no {kind} {item}, expected 0 to {count - 1}")
    return ids


def _name(model: Any, kind: str, index: int) -> str:
    start = int(getattr(model, f"name_{kind}adr")[index])
    return model.names[start : model.names.index(b"\0", start)].decode()


def cover_geom(
    model: Any, geom: int, tolerance: float, check_time: Callable[[], None]
) -> cover.SphereCover:
    """Covers a geom by spheres.

    Args:
        model: A model.
        geom: Its id.
        tolerance: Most that a sphere may protrude, m, > 0.
        check_time: Called now and then; may raise to stop.

    Returns:
        The spheres, in the frame of the geom's body.

    Raises:
        ValueError: The geom is a plane, a height field or an SDF.
    """
    centers, radii = _cover_shape(model, geom, tolerance, check_time)
    rotation = _rotation(np.asarray(model.geom_quat[geom], float))
    return np.asarray(model.geom_pos[geom], float) + centers @ rotation.T, radii


def describe_geom(model: Any, geom: int) -> list[np.ndarray]:
    """Lists all that the cover of a geom depends on, but the tolerance.

    Args:
        model: A model.
        geom: Its id.

    Returns:
        Arrays.
    """
    names = ("geom_type", "geom_bodyid", "geom_size", "geom_pos", "geom_quat")
    described = [np.asarray(getattr(model, name)[geom]) for name in names]
    mesh = int(model.geom_dataid[geom])
    return described + (list(_mesh(model, mesh)) if mesh >= 0 else [])


def _cover_shape(
    model: Any, geom: int, tolerance: float, check_time: Callable[[], None]
) -> cover.SphereCover:
    """Covers a geom in its own frame."""
    # Imported here: nothing else in this module needs it.
    import mujoco

    size = np.asarray(model.geom_size[geom], float)
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return cover.cover_capsule(size[0], 0.0, tolerance)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return cover.cover_capsule(size[0], size[1], tolerance)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return cover.cover_box(size, tolerance)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        half = size[[0, 0, 1]]
        return cover.cover_solid(
            solids.cylinder(size[0], size[1]), -half, half, tolerance, check_time
        )
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return cover.cover_solid(solids.ellipsoid(size), -size, size, tolerance, check_time)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        vertices, faces = _mesh(model, int(model.geom_dataid[geom]))
        solid = solids.mesh(vertices, faces, tolerance)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        return cover.cover_solid(solid, low, high, tolerance, check_time)
    raise ValueError(
        f"geom {geom} ({_name(model, 'geom', geom)!r}) is of type "
        f"{kind.name.removeprefix('mjGEOM_').lower()}, expected sphere, capsule, box, cylinder, "
        f"ellipsoid or mesh"
    )


def _mesh(model: Any, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m, geom frame, and faces (F, 3) of a mesh."""

    def rows(array: Any, starts: Any) -> np.ndarray:
        last = starts[mesh + 1] if mesh + 1 < len(starts) else len(array)
        return np.asarray(array)[starts[mesh] : last]

    vertices = rows(model.mesh_vert, model.mesh_vertadr).astype(float)
    return vertices, rows(model.mesh_face, model.mesh_faceadr)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
