"""A MuJoCo robot as spheres on its bodies, and their clearance in a configuration."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.points import AnyField, Unknown
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.exporting import exportable
from hiosdf_jax._src.numerics.gradient import least
from hiosdf_jax._src.numerics.intake import as_number
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax._src.planning.robot import cover, solids
from hiosdf_jax._src.state import Bound


@exportable()
class RobotSpheres(flax.struct.PyTreeNode):
    """Spheres on the bodies of a robot; made by `spheres_from_model`.

    Attributes:
        body: Index of the body that carries each sphere, (S,) int32.
        centers_body: Centers in that body's frame, (S, 3) float32, m.
        radii: (S,) float32, m.
    """

    body: jax.Array
    centers_body: jax.Array
    radii: jax.Array


@exportable()
class BodyPoses(NamedTuple):
    """Poses of bodies; `mjx.Data` and `mujoco.MjData` have the same two attributes.

    Attributes:
        xpos: Origins of the bodies' frames, (..., B, 3) m, world.
        xmat: Rotations T_world_body, (..., B, 3, 3) or row-major (..., B, 9).
    """

    xpos: Any
    xmat: Any


def spheres_from_model(
    model: Any,
    tolerance_m: float,
    bodies: Iterable[int | str] | None = None,
    geoms: Iterable[int | str] | None = None,
    *,
    budget_s: float = math.inf,
) -> RobotSpheres:
    """Covers geoms of a robot by spheres that protrude by at most a tolerance.

    The cover is complete. A mesh is covered as it is, with all that it encloses, not as the convex
    hull that MuJoCo collides. Half the tolerance takes about four times as many spheres. Not inside
    jit. Meshes take seconds to minutes: a bar in the terminal shows the progress.

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)

    Args:
        model: `mujoco.MjModel`, `mjx.Model`, `mujoco.MjSpec`, or the path of an XML file.
        tolerance_m: Most that a sphere may protrude beyond its geom, m, > 0.
        bodies: Names or ids of the bodies whose colliding geoms (contype or conaffinity not 0)
            are covered; by default those that can move, or all but the world if none can.
        geoms: Names or ids of the geoms to cover, instead of `bodies`.
        budget_s: Longest time that it may take, s. It is exceeded by up to the time of one search.

    Returns:
        The spheres, in the order of the geoms.

    Warns:
        UserWarning: A chosen body has geoms, but none that collides: nothing covers it.

    Raises:
        ValueError: The tolerance is not positive, a body or geom is unknown, no geom is chosen, or
            a chosen geom is a plane, a height field or an SDF.
        TimeoutError: The time is up.
    """
    # Imported here: a robot that loads its spheres from a file needs no progress bar.
    from tqdm import tqdm

    tolerance_m = as_number("tolerance_m", tolerance_m, 0, above=True)
    model = _compiled_model(model)
    chosen = _chosen_geoms(model, bodies, geoms)
    start, parts = time.monotonic(), []

    def check_time() -> None:
        if time.monotonic() - start > budget_s:
            raise TimeoutError(
                f"covered {len(parts)} of {len(chosen)} geoms in budget_s = {budget_s} s, expected "
                f"all: allow more time, a tolerance above {tolerance_m} m, or simpler geoms"
            )

    # Without a terminal, or within two seconds, nothing is shown.
    for geom in tqdm(chosen, desc="covering geoms by spheres", delay=2, disable=None):
        check_time()
        centers, radii = _cover_geom(model, geom, tolerance_m, check_time)
        rotation = _rotation(np.asarray(model.geom_quat[geom], float))
        centers_body = np.asarray(model.geom_pos[geom], float) + centers @ rotation.T
        body = np.full(len(radii), model.geom_bodyid[geom])
        parts.append((body, centers_body, radii))
    body, centers_body, radii = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return RobotSpheres(
        body=jnp.asarray(body, jnp.int32),
        centers_body=jnp.asarray(centers_body, jnp.float32),
        radii=jnp.asarray(radii, jnp.float32),
    )


@plain
def place_spheres(spheres: RobotSpheres, data: Any) -> jax.Array:
    """Places a robot's spheres in a configuration.

    Args:
        spheres: The robot's spheres.
        data: The bodies' poses as `xpos` and `xmat`: `mjx.Data` after `mjx.kinematics` or a step,
            `mujoco.MjData`, or `BodyPoses`.

    Returns:
        Centers, (..., S, 3) float32, m, world. Differentiable. Inside jit they are NaN, i.e. in
        collision, on bodies without a pose.

    Raises:
        ValueError: An argument is of a wrong kind, a shape of the poses is wrong, there are fewer
            bodies than the spheres need, or (outside jit) kinematics has not run.

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)
        centers_world = planning.place_spheres(spheres, data)
    """
    _check_spheres(spheres)
    if not (hasattr(data, "xpos") and hasattr(data, "xmat")):
        raise ValueError(f"data is {type(data).__name__}, expected bodies' poses xpos and xmat")
    xpos, xmat = on_device("data.xpos", data.xpos), on_device("data.xmat", data.xmat)
    if xpos.ndim < 2 or xpos.shape[-1] != 3:
        raise ValueError(f"data.xpos has shape {xpos.shape}, expected (..., B, 3)")
    if xmat.shape not in ((*xpos.shape, 3), (*xpos.shape[:-1], 9)):
        raise ValueError(
            f"data.xmat has shape {xmat.shape}, expected {(*xpos.shape, 3)}, as data.xpos has "
            f"shape {xpos.shape}"
        )
    if not isinstance(spheres.body, jax.core.Tracer) and spheres.body.size:
        largest = int(np.max(np.asarray(spheres.body)))
        if largest >= xpos.shape[-2]:
            raise ValueError(
                f"data has {xpos.shape[-2]} bodies, expected more than {largest}, the largest "
                f"index in spheres.body"
            )
    rotations = xmat.reshape(*xpos.shape, 3)[..., spheres.body, :, :]
    # Before kinematics MuJoCo's rotations are zero.
    posed = jnp.any(rotations != 0, axis=(-2, -1))[..., None]
    if not isinstance(posed, jax.core.Tracer) and not np.all(jax.device_get(posed)):
        raise ValueError(
            "data.xmat has rotations that are zero, expected poses of all bodies: run "
            "mujoco.mj_kinematics(model, data) or mjx.kinematics(model, data) first"
        )
    # Sums of products: a matrix product may run in reduced precision on a GPU.
    offsets_world = jnp.sum(rotations * spheres.centers_body[:, None, :], axis=-1)
    return jnp.where(posed, xpos[..., spheres.body, :] + offsets_world, jnp.nan)


@plain
def robot_clearance(
    field: AnyField,
    spheres: RobotSpheres,
    data: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> jax.Array:
    """Computes the least clearance of a robot's spheres in a configuration.

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)
        clearance = planning.robot_clearance(field, spheres, data)

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        spheres: The robot's spheres.
        data: As for `place_spheres`.
        unknown: Policy for space that no ray has reached: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (...) float32, m; negative in collision. Differentiable, through `mjx.kinematics` also by
        the joint positions.

    Raises:
        ValueError: As for `place_spheres` and `sphere_clearance`.
    """
    centers_world = place_spheres(spheres, data)
    return least(sphere_clearance(field, centers_world, spheres.radii, unknown, bound))


@plain
def robot_clearance_and_grad(
    field: AnyField,
    spheres: RobotSpheres,
    data: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes the clearance of a robot and its gradient by the motion of each body.

    With the Jacobians of a body, for instance from `mujoco.mj_jacBody`, the gradient by the joints
    is the sum over bodies b of jacp_b^T by_position[b] + jacr_b^T by_rotation[b].

    Example:
        model = mujoco.MjModel.from_xml_path("examples/rover.xml")
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        spheres = planning.spheres_from_model(model, tolerance_m=0.02)
        clearance, by_position, by_rotation = planning.robot_clearance_and_grad(
            field, spheres, data
        )

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        spheres: The robot's spheres.
        data: As for `place_spheres`.
        unknown: Policy for space that no ray has reached: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: As for `robot_clearance`.

    Returns:
        The clearance (...) float32, m, and its gradients by the bodies' positions, (..., B, 3), and
        by rotations around the origins of their frames, (..., B, 3) m/rad, world frame.

    Raises:
        ValueError: As for `robot_clearance`.
    """
    xpos = on_device("data.xpos", data.xpos)
    centers_world = place_spheres(spheres, data)
    value, slope = sphere_clearance_and_grad(field, centers_world, spheres.radii, unknown, bound)
    nearest = jnp.arange(value.shape[-1]) == jnp.argmin(value, axis=-1)[..., None]
    force = jnp.where(nearest[..., None], slope, 0)
    torque = jnp.cross(centers_world - xpos[..., spheres.body, :], force)

    def per_body(vectors: jax.Array) -> jax.Array:
        return jnp.zeros_like(xpos).at[..., spheres.body, :].add(vectors)

    return least(value), per_body(force), per_body(jnp.where(nearest[..., None], torque, 0))


def _compiled_model(model: Any) -> Any:
    """Reads the model of a file, or compiles that of a specification."""
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


def _check_spheres(spheres: Any) -> None:
    if not isinstance(spheres, RobotSpheres):
        raise ValueError(
            f"spheres is {type(spheres).__name__}, expected RobotSpheres from spheres_from_model"
        )


def _chosen_geoms(model: Any, bodies: Any, geoms: Any) -> list[int]:
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


def _cover_geom(
    model: Any, geom: int, tolerance: float, check_time: Callable[[], None]
) -> cover.SphereCover:
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
