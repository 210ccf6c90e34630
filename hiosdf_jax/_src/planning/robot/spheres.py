"""A MuJoCo robot as spheres on its bodies, and their places in a configuration."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.describing import Described
from hiosdf_jax._src.numerics.exporting import exportable
from hiosdf_jax._src.numerics.intake import as_number
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.output_files import check_output
from hiosdf_jax._src.planning.robot.cover import SphereCover
from hiosdf_jax._src.planning.robot.cover_files import cache_key, read_covers, write_covers
from hiosdf_jax._src.planning.robot.geoms import (
    chosen_geoms,
    compiled_model,
    cover_geom,
    describe_geom,
)


@exportable()
class RobotSpheres(Described):
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
    cache: str | os.PathLike[str] | None = None,
) -> RobotSpheres:
    """Covers geoms of a robot by spheres that protrude by at most a tolerance.

    The cover is complete. A mesh is covered as it is, with all that it encloses, not as the convex
    hull that MuJoCo checks. Half the tolerance takes about four times as many spheres. Not inside
    jit. Meshes take seconds: a bar in the terminal shows the progress, and `cache` keeps the
    result.

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
        cache: An `.npz` file, whose folder must exist. If it holds the spheres of the same geoms
            and tolerance they are read from it, otherwise it is written.

    Returns:
        The spheres, in the order of the geoms.

    Warns:
        UserWarning: A chosen body has geoms, but none that collides: nothing covers it.

    Raises:
        ValueError: The tolerance is not positive, a body or geom is unknown, no geom is chosen, a
            chosen geom is a plane, a height field or an SDF, or `cache` is another kind of file.
        TimeoutError: The time is up.
        OSError: The file cannot be read or written.
    """
    tolerance_m = as_number("tolerance_m", tolerance_m, 0, above=True)
    if budget_s != math.inf:
        budget_s = as_number("budget_s", budget_s)
    model = compiled_model(model)
    chosen = chosen_geoms(model, bodies, geoms)
    if cache is None:
        covers = _cover_geoms(model, chosen, tolerance_m, budget_s)
    else:
        key = cache_key(tolerance_m, [describe_geom(model, geom) for geom in chosen])
        covers = read_covers(cache, key, len(chosen))
        if covers is None:
            check_output(cache)
            covers = _cover_geoms(model, chosen, tolerance_m, budget_s)
            write_covers(cache, key, covers)
    carriers = np.asarray(model.geom_bodyid)[chosen]
    return RobotSpheres(
        body=jnp.asarray(np.repeat(carriers, [len(radii) for _, radii in covers]), jnp.int32),
        centers_body=jnp.asarray(np.concatenate([centers for centers, _ in covers]), jnp.float32),
        radii=jnp.asarray(np.concatenate([radii for _, radii in covers]), jnp.float32),
    )


def _cover_geoms(
    model: Any, chosen: list[int], tolerance: float, budget_s: float
) -> list[SphereCover]:
    """Covers geoms on all cores: numpy and scipy let other threads run while they work."""
    # Imported here: a robot that loads its spheres from a file needs no progress bar.
    from tqdm import tqdm

    start, done, stopped = time.monotonic(), [], threading.Event()

    def check_time() -> None:
        if stopped.is_set() or time.monotonic() - start > budget_s:
            raise TimeoutError(
                f"covered {len(done)} of {len(chosen)} geoms in budget_s = {budget_s} s, expected "
                f"all: allow more time, a tolerance above {tolerance} m, or simpler geoms"
            )

    def covered(geom: int) -> SphereCover:
        check_time()
        found = cover_geom(model, geom, tolerance, check_time)
        done.append(geom)
        return found

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            # Without a terminal, or within two seconds, nothing is shown.
            found = tqdm(
                pool.map(covered, chosen),
                total=len(chosen),
                desc="covering geoms by spheres",
                delay=2,
                disable=None,
            )
            return list(found)
        finally:
            stopped.set()  # an error or an interrupt ends the other threads, too


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


def _check_spheres(spheres: Any) -> None:
    if not isinstance(spheres, RobotSpheres):
        raise ValueError(
            f"spheres is {type(spheres).__name__}, expected RobotSpheres from spheres_from_model"
        )
