"""Decides whether a cloud fits a map at a pose.

Floors and ceilings fit at many poses, and most returns of a wrong pose may lie in space that the
map has not seen. So returns that fit count by how much their normals differ, and rays that would
have entered known solids count against a pose.
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
from hiosdf_jax._src.mapping.registration.matching import find_blocked
from hiosdf_jax._src.state.pytrees import Baked, Field

LEAST_INLIERS = 0.7
"""Share of the returns in observed space that must lie on its surfaces."""

# Returns that fit count by how much their normals differ: 0 on one plane, 0.42 if they point
# everywhere. Together with an allowance, a share of all returns that stands for noise, they are the
# support of a pose. It must be at least this share of the sum of support and contradiction.
_LEAST_SHARE = 0.4
_ALLOWANCE = 0.02

# Returns in free space may be of a person. Nothing new explains rays through known solids, so each
# counts as this many more returns above a share that is usual: behind walls that were seen from one
# side, solids are a guess. With half of it, the apartment's map refused a view through a door, and
# then the next twelve: what would have cleared the guess was not fused. At right poses 0.07 of the
# rays are blocked there, and at most 0.03 in four recordings, but for one frame.
_BLOCKED_WEIGHT = 12
_BLOCKED_ALLOWANCE = 0.08

_RAYS = 256


class Verdict(NamedTuple):
    """How well a cloud fits a map at a pose.

    Attributes:
        residual: Root mean square distance of the inliers from the surface, () m.
        inliers: Share of the returns in observed space that lie on a surface, ().
        fits: The pose can be trusted as far as the returns tell, () bool.
    """

    residual: jax.Array
    inliers: jax.Array
    fits: jax.Array


def judge(field: Field | Baked, rows: Rows, pose: jax.Array) -> Verdict:
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
    variety = 1 - jnp.linalg.norm(second) / jnp.maximum(jnp.trace(second), 1e-9)
    rays = take_evenly(rows, _RAYS)
    blocked = find_blocked(field, pose, rays.points, rays.some)
    blocked_share = jnp.sum(blocked) / jnp.maximum(jnp.sum(rays.some), 1)
    blocked_share += _BLOCKED_WEIGHT * jnp.maximum(blocked_share - _BLOCKED_ALLOWANCE, 0)
    contrary = jnp.sum(judged & ~on_surface) + blocked_share * total
    supporting = variety * inliers + _ALLOWANCE * total

    share = inliers.astype(jnp.float32) / jnp.maximum(jnp.sum(judged), 1).astype(jnp.float32)
    fits = comparable >= jnp.maximum(LEAST_COMPARABLE * total, 1)
    fits &= share >= LEAST_INLIERS
    fits &= supporting >= _LEAST_SHARE * (supporting + contrary)
    return Verdict(jnp.sqrt(square), share, fits)
