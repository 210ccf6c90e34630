"""Decides whether a cloud fits a map at a pose.

Floors and ceilings fit at many poses, and most returns of a wrong pose may lie in space that the
map has not seen. So returns that fit count by how much their normals differ, and rays that would
have entered known solids count against a pose, most where no return holds it along them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.mapping.registration.comparing import (
    INLIER_DEVIATIONS,
    Rows,
    compare,
    take_evenly,
)
from hiosdf_jax._src.mapping.registration.equations import LEAST_COMPARABLE
from hiosdf_jax._src.mapping.registration.matching import between, find_blocked
from hiosdf_jax._src.mapping.registration.motion import offsets_from
from hiosdf_jax._src.numerics.small_matrices import solve_positive
from hiosdf_jax._src.numerics.vectors import join, split, unit
from hiosdf_jax._src.state.pytrees import Baked, Field

LEAST_INLIERS = 0.7
"""Share of the returns in observed space that must lie on its surfaces."""

# Returns that fit count by how much their normals differ: 0 on one plane, 0.42 if they point
# everywhere. Together with an allowance, a share of all returns that stands for noise, they are the
# support of a pose. It must be at least this share of the sum of support and contradiction.
_LEAST_SHARE = 0.4
_ALLOWANCE = 0.02

# Rays through known solids: either something is gone, or the pose is too far along the rays. How
# well the returns that fit hold the pose along a ray is 1 / d^T N^-1 d, where N is the mean outer
# product of their normals: 1 if all normals are along the ray, and a third if they point
# everywhere. Along a tube it is 0, or 0.03 by chance. A blocked ray counts as the first weight at
# 0, and as the second one from _FULL_HOLD on. A map that refuses a right pose never sees that
# something is gone.
_GONE_WEIGHTS = 10.0, 0.5
_FULL_HOLD = 0.05
_LEAST_HOLD = 1e-3

# A right pose rarely has both blocked rays and returns that do not fit, so the geometric mean of
# the two counts most. One ray may be both: through a solid, and to a return in free space.
_BOTH_WEIGHT = 3.0

_RAYS = 256


class PoseVerdict(NamedTuple):
    """How well a cloud fits a map at a pose.

    Attributes:
        residual: Root mean square distance of the inliers from the surface, () m.
        inliers: Share of the returns in observed space that lie on a surface, ().
        fits: The returns support the pose, () bool.
    """

    residual: jax.Array
    inliers: jax.Array
    fits: jax.Array


def judge(field: Field | Baked, rows: Rows, pose: jax.Array) -> PoseVerdict:
    """Judges a pose.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4) T_world_sensor.

    Returns:
        The verdict.
    """
    even = take_evenly(rows)
    seen = compare(field, even, pose, 0.0)
    on_surface = seen.comparable & (jnp.abs(seen.distance) < INLIER_DEVIATIONS * seen.sigma)
    judged = seen.comparable | seen.contrary
    inliers, comparable, total = (
        jnp.sum(part) for part in (on_surface, seen.comparable, even.some)
    )
    square = jnp.sum(jnp.where(on_surface, seen.distance**2, 0)) / jnp.maximum(inliers, 1)

    normals = jnp.where(on_surface[:, None], seen.jacobian[:, :3], 0)
    second = jnp.matmul(normals.T, normals, precision="highest")
    trace = jnp.maximum(jnp.trace(second), 1e-9)
    variety = 1 - jnp.linalg.norm(second) / trace
    rays = take_evenly(rows, _RAYS)
    blocked = find_blocked(field, pose, rays.points, rays.some)
    weight = _weigh_blocked(second / trace, offsets_from(pose, rays.points))
    per_ray = total / jnp.maximum(jnp.sum(rays.some), 1)
    gone = per_ray * jnp.sum(blocked)
    new = jnp.sum(judged & ~on_surface).astype(jnp.float32)
    contrary = new + per_ray * jnp.sum(weight * blocked) + _BOTH_WEIGHT * jnp.sqrt(new * gone)
    supporting = variety * inliers + _ALLOWANCE * total

    share = inliers.astype(jnp.float32) / jnp.maximum(jnp.sum(judged), 1).astype(jnp.float32)
    fits = comparable >= jnp.maximum(LEAST_COMPARABLE * total, 1)
    fits &= share >= LEAST_INLIERS
    fits &= supporting >= _LEAST_SHARE * (supporting + contrary)
    return PoseVerdict(jnp.sqrt(square), share, fits)


def _weigh_blocked(mean_product: jax.Array, offset: jax.Array) -> jax.Array:
    """Returns how much a blocked ray counts: more where the returns that fit do not hold the pose.

    Args:
        mean_product: Mean outer product of the normals of those returns, (3, 3).
        offset: From the sensor to the end of each ray, (N, 3) m, along the axes of the world.

    Returns:
        (N,).
    """
    direction = join(unit(split(offset)))
    product = mean_product + _LEAST_HOLD * jnp.eye(3)
    hold = 1 / jnp.sum(direction * solve_positive(product, direction), axis=-1)
    return jnp.asarray(between(_GONE_WEIGHTS, jnp.minimum(hold / _FULL_HOLD, 1)))
