"""Whether a cloud agrees with the map as a whole, or is a fault of the sensor, pose, scale or unit.

The rays of a faulty cloud end in space that was seen free, or go through walls. So do those to
things that have changed. But beside a change, returns lie on surfaces that hold the pose in every
direction. At a wrong pose, only those lie on surfaces along which it has moved, such as the floor.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.change.piercing import find_piercing
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.modes import run_if
from hiosdf_jax._src.numerics.vectors import cross, dot, split
from hiosdf_jax._src.state.pytrees import Grid

CONFIDENT_UPDATES = 5
"""The map can judge a cloud after this many updates."""

_JUDGED = 1024  # rays, about

# Returns within this distance of a surface agree with the map, and count by how much their normals
# differ: 0 on one plane, 0.42 if they point everywhere. Together with an allowance, a share of all
# rays that stands for noise, they support the pose.
_AGREEING_VOXELS = 1.0
_ALLOWANCE = 0.02

# Rays that go through walls count half as much as returns in free space. A right pose rarely has
# both, so their geometric mean counts most.
_PIERCING_WEIGHT = 0.5
_BOTH_WEIGHT = 3.0

# A cloud contradicts the map if its support is less than this share of the sum of support and
# contradiction, and if at least this share of all rays is wrong. Of 1,100 clouds at right poses
# (houses, kitchen, hall, apartment, and a room with people, doors and boxes that move) one had less
# than 0.55: 0.39, with 6 % of wrong rays. Of 628 at poses 1 m off, 94 % contradict the map.
_LEAST_SUPPORT = 0.45
_LEAST_WRONG = 0.07

# A wardrobe or a person close by may change half of the view. Then at least this share of the rays
# agrees with the map, and this share of those that are not news lies as near to the planes of their
# patches as a right pose allows. Their normals hold the pose in every direction: the harmonic mean
# of the eigenvalues of their mean outer product, divided by 3, is at least this, of at most 1 / 9.
_LEAST_UNCHANGED = 0.5
_LEAST_ON_PLANES = 0.95
_ON_PLANE_VOXELS = 0.3
_LEAST_HOLD = 0.05

# Something that fills the view is news: nothing goes through walls, and what is seen beside it is
# where the map has it, up to a voxel. At least this share of the rays must see that, and this share
# of those that do not end in free space. Walls that seem nearer at a wrong pose look alike, but
# beside them fewer rays agree.
_LEAST_AGREEING = 0.1
_LEAST_BESIDE = 0.9
_MOST_PIERCING = 0.02

# In a view of any world, neighboring rays have similar ranges. See `directions.smoothness`: 0.56 or
# more on four streams, with 5 cm of noise as well, and at most 0.18 in random clouds. A cloud that
# is less smooth contradicts the map with fewer wrong rays. In a room that is half known, 22 % of
# the rays of random clouds are wrong, and half of those that can be compared.
_LEAST_SMOOTH = 0.4
_NOISE_WRONG = 0.2
_LEAST_NOISE_WRONG = 0.1


class Compared(NamedTuple):
    """The returns of a cloud, compared with the map.

    Attributes:
        known: The return is in observed space and not near new surfaces, (N,) bool.
        novel: The return is in space that was free, (N,) bool.
        distance: From the nearest surface, (N,) m.
        patch: Voxel of the nearest patch, an index into the raveled grid, (N,) int32.
    """

    known: jax.Array
    novel: jax.Array
    distance: jax.Array
    patch: jax.Array


class CloudVerdict(NamedTuple):
    """What a cloud is worth.

    Attributes:
        consistent: The cloud agrees with the map, or the map cannot judge it, () bool.
        noise: It does not, and its rays disagree with each other, () bool: it is not a view of any
            world.
    """

    consistent: jax.Array
    noise: jax.Array


class _Normals(NamedTuple):
    """How much the normals of some returns differ.

    Attributes:
        variety: 0 if all are parallel, 0.42 if they point everywhere, ().
        hold: 0 if the returns do not hold the pose along some direction, 1 / 9 if they hold it
            equally along all, ().
    """

    variety: jax.Array
    hold: jax.Array


def judge(
    config: Config, grid: Grid, rays: Rays, updates: jax.Array, compared: Compared
) -> CloudVerdict:
    """Judges a cloud by about a thousand of its rays.

    Args:
        config: The map's configuration.
        grid: The grid before the cloud is fused.
        rays: The cloud.
        updates: Number of updates of the map, () int32.
        compared: Its returns.

    Returns:
        The verdict.
    """
    every = max(rays.ends.size // _JUDGED, 1)
    some = Rays(*(part if part is rays.sensor_world else part[::every] for part in rays))
    known, novel, distance, patch = (part[::every] for part in compared)
    piercing = find_piercing(config, grid, some)
    known &= ~piercing
    near = known & ~novel & (distance < _AGREEING_VOXELS * config.voxel_size)
    height, normal = _planes_of(config, grid, patch, some.points_world)
    on_plane = known & ~novel
    on_plane &= jnp.abs(height) < _ON_PLANE_VOXELS * config.voxel_size + 2 * some.sigma
    counted = (some.in_range, known, piercing, known & novel, near, on_plane)
    total, seen, through, in_free, agreeing, on_planes = (
        jnp.sum(rows, dtype=jnp.float32) for rows in counted
    )
    comparable, wrong = seen + through, in_free + through

    def look(_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        every_ray = directions.smoothness(rays, rays.in_range)
        return every_ray, directions.smoothness(rays, compared.novel)

    suspicious = (updates >= CONFIDENT_UPDATES) & (wrong > _LEAST_WRONG * total)
    unknown = jnp.float32(directions.UNKNOWN)
    smooth, smooth_novel = run_if(suspicious, look, (unknown, unknown), rays, compared)
    noise = suspicious & (smooth != directions.UNKNOWN) & (smooth < _LEAST_SMOOTH)
    noise &= (wrong > _NOISE_WRONG * comparable) & (wrong > _LEAST_NOISE_WRONG * total)

    normals = _differ(normal, near)
    support = normals.variety * agreeing + _ALLOWANCE * total
    contradiction = in_free + _PIERCING_WEIGHT * through
    contradiction += _BOTH_WEIGHT * jnp.sqrt(in_free * through)
    unchanged = (
        (agreeing >= _LEAST_UNCHANGED * comparable)
        & (on_planes >= _LEAST_ON_PLANES * (seen - in_free))
        & (normals.hold >= _LEAST_HOLD)
    )
    fills_view = (
        (smooth_novel >= _LEAST_SMOOTH)
        & (through <= _MOST_PIERCING * comparable)
        & (agreeing >= _LEAST_AGREEING * comparable)
        & (agreeing >= _LEAST_BESIDE * (comparable - in_free))
    )
    contradicts = suspicious & (support < _LEAST_SUPPORT * (support + contradiction))
    contradicts &= ~unchanged & ~fills_view
    return CloudVerdict(~(contradicts | noise), noise)


def _planes_of(
    config: Config, grid: Grid, patch: jax.Array, points_world: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the height of points above the planes of patches.

    Args:
        config: The map's configuration.
        grid: The grid.
        patch: Voxels of the patches, indices into the raveled grid, (N,) int32.
        points_world: (N, 3) m.

    Returns:
        Heights, (N,) m, and the normals, (N, 3): 0 for a voxel without a patch.
    """
    evidence = grid.evidence
    index = jnp.stack(geometry.unflatten(config.grid_shape, patch), axis=-1)
    offset = (points_world - geometry.voxel_center(config, index)) / config.voxel_size
    normal = evidence.axes.reshape(-1, 3, 3)[patch, 2].astype(jnp.float32)
    normal /= jnp.maximum(jnp.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    above = offset - evidence.mean.reshape(-1, 3)[patch].astype(jnp.float32)
    return config.voxel_size * jnp.sum(above * normal, axis=-1), normal


def _differ(normal: jax.Array, chosen: jax.Array) -> _Normals:
    """Computes how much the chosen (N,) of some unit normals (N, 3) differ."""
    normal = jnp.where(chosen[:, None], normal, 0)
    product = jnp.sum(normal[:, :, None] * normal[:, None, :], axis=0)
    product /= jnp.maximum(jnp.trace(product), 1e-9)
    square = jnp.sum(product**2)
    first, second, third = (split(row) for row in product)
    # The sum of the products of two eigenvalues; with the determinant, the sum of their inverses.
    minors = jnp.maximum((1 - square) / 2, 1e-9)
    return _Normals(1 - jnp.sqrt(square), dot(first, cross(second, third)) / minors)
