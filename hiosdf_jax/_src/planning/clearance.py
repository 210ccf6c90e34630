"""Checks spheres against the map; `robot.clearance` checks those of a robot."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.queries import AnyField, Unknown, distance, distance_and_grad
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.intake import check_vectors, is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.state.pytrees import Bound

_FAR = 1e30  # m


@plain
def sphere_clearance(
    field: AnyField,
    centers_world: Any,
    radii: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> jax.Array:
    """Computes the signed distance of spheres to the nearest surface: sdf(center) - radius.

    Example:
        centers_world = jnp.array([[0.5, 0.0, 0.3], [0.7, 0.0, 0.3]])
        clearance = planning.sphere_clearance(field, centers_world, radii=0.1)

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        centers_world: (..., 3) m.
        radii: m, >= 0; any shape that broadcasts to that of the spheres, (...).
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        (...) float32, m; negative in collision, by the depth of penetration. Differentiable.

    Raises:
        ValueError: A shape is wrong, or (outside jit) a radius is negative or not finite.
    """
    centers, radii = checked_spheres(centers_world, radii, "centers_world")
    return distance(field, centers, unknown, bound) - radii


@plain
def sphere_clearance_and_grad(
    field: AnyField,
    centers_world: Any,
    radii: Any,
    unknown: Unknown = "obstacle",
    bound: Bound = "sdf",
) -> tuple[jax.Array, jax.Array]:
    """Computes the clearance of spheres and its gradient, by one reverse-mode evaluation.

    Args:
        field: A map, a snapshot of one, or a baked snapshot.
        centers_world: (..., 3) m.
        radii: As for `sphere_clearance`.
        unknown: Policy for unseen space: "obstacle" takes it as solid, "network"
            uses the map's prediction.
        bound: "sdf" keeps clear of the estimated surfaces, "lower" of the calibrated lower bound
            of the distance; see `hiosdf_jax.query`.

    Returns:
        The clearance (...) float32, m, and d(clearance)/d(center), (..., 3) float32.

    Raises:
        ValueError: As for `sphere_clearance`.

    Example:
        centers_world = jnp.array([[0.5, 0.0, 0.3], [0.7, 0.0, 0.3]])
        clearance, grad = planning.sphere_clearance_and_grad(field, centers_world, radii=0.1)
    """
    centers, radii = checked_spheres(centers_world, radii, "centers_world")
    value, gradient = distance_and_grad(field, centers, unknown, bound)
    return value - radii, gradient


def checked_spheres(centers: Any, radii: Any, name: str) -> tuple[jax.Array, jax.Array]:
    """Checks the centers of spheres, and their radii against them.

    Args:
        centers: (..., 3) m.
        radii: m.
        name: The caller's name for the centers.

    Returns:
        The centers and the radii, float32; traced radii that are negative or not finite become
        1e30 m.

    Raises:
        ValueError: A type or a shape is wrong, or (outside jit) a radius is negative or not finite.
    """
    centers, radii = on_device(name, centers), on_device("radii", radii)
    check_vectors(name, centers)
    shape = centers.shape
    traced = is_traced(radii)
    if not traced:
        values = np.asarray(jax.device_get(radii))
        wrong = ~((values >= 0) & np.isfinite(values))
        if wrong.any():
            raise ValueError(
                f"radii has {wrong.sum()} negative or non-finite values, expected all >= 0: "
                f"{[float(f'{x:.6g}') for x in values[wrong][:5]]} at "
                f"{np.argwhere(wrong)[:5].tolist()}"
            )
    # Radii must not enlarge the batch: each sphere has one.
    dimensions = zip(radii.shape[::-1], shape[-2::-1], strict=False)
    if radii.ndim >= len(shape) or any(own not in (1, batch) for own, batch in dimensions):
        raise ValueError(
            f"radii has shape {radii.shape}, expected one that broadcasts to {shape[:-1]}, "
            f"the spheres of {name}"
        )
    # Inside jit an invalid radius is in collision: NaN would compare as clear.
    return centers, jnp.where((radii >= 0) & (radii <= _FAR), radii, _FAR) if traced else radii
