"""Whether a cloud agrees with the map as a whole, or is a fault of the sensor, pose, scale or unit.

The rays of a faulty cloud end in space that was seen free, or go through walls. Rays to things that
have changed do so, too. So a cloud is a fault if most of its rays are wrong, if they disagree with
each other, or if another pose explains them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hiosdf_jax._src.change import directions
from hiosdf_jax._src.change.misplaced import is_misplaced
from hiosdf_jax._src.change.piercing import find_piercing
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.rays import Rays
from hiosdf_jax._src.numerics.masks import spread_rows
from hiosdf_jax._src.numerics.modes import run_if
from hiosdf_jax._src.state.pytrees import Grid

CONFIDENT_UPDATES = 5
"""The map can judge a cloud after this many updates."""

_JUDGED = 1024  # rays

# A cloud contradicts the map if more than this share of the rays that can be compared is wrong, and
# this share of all rays: they end in free space or go through walls. On house_depth and house_lidar
# at most 6 % are wrong, and 34 % in the apartment seen in 24 frames. With rays 1.3 times as
# long it is 76 % or more.
_MOST_WRONG = 0.5
_LEAST_WRONG = 0.25

# With this share of all rays wrong, another pose is searched for.
_LEAST_MISPLACED = 0.05

# Something that fills the view is news: nothing goes through walls, and what is seen beside it is
# where the map has it, up to a voxel. At least this share of the rays must see that, and this share
# of those that do not end in free space. On both streams at most 9 % of the rays do where they are
# 0.3 to 0.8 times as long as they should be.
_LEAST_AGREEING = 0.1
_LEAST_BESIDE = 0.75
_MOST_PIERCING = 0.05
_AGREEING_VOXELS = 1.0

# A board that appears looks like a wall that is seen from a pose too far ahead. A board that is
# missing in the map is the greater danger. So the cloud is news if even fewer rays go through walls
# and nearly all returns beside it agree.
_MOST_PIERCING_ELSEWHERE = 0.02
_LEAST_BESIDE_ELSEWHERE = 0.9

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
    """

    known: jax.Array
    novel: jax.Array
    distance: jax.Array


class CloudVerdict(NamedTuple):
    """What a cloud is worth.

    Attributes:
        consistent: The cloud agrees with the map, or the map cannot judge it, () bool.
        noise: It does not, and its rays disagree with each other, () bool: it is not a view of any
            world.
    """

    consistent: jax.Array
    noise: jax.Array


def judge(
    config: Config, grid: Grid, rays: Rays, updates: jax.Array, compared: Compared
) -> CloudVerdict:
    """Judges a cloud by at most 1,024 of its rays.

    Args:
        config: The map's configuration.
        grid: The grid before the cloud is fused.
        rays: The cloud.
        updates: Number of updates of the map, () int32.
        compared: Its returns.

    Returns:
        The verdict.
    """
    row = spread_rows(rays.in_range, min(rays.in_range.size, _JUDGED))
    some = Rays(*(part if part is rays.sensor_world else part[row] for part in rays))
    known, novel, distance = (part[row] for part in compared)
    piercing = find_piercing(config, grid, some)
    known &= ~piercing
    near = known & ~novel & (distance < _AGREEING_VOXELS * config.voxel_size)
    counted = (some.in_range, piercing, known & novel, near)
    total, through, in_free, agreeing = (jnp.sum(rows) for rows in counted)
    comparable, wrong = jnp.sum(known) + through, in_free + through

    def exceeds(most: float, least: float) -> jax.Array:
        return (wrong > most * comparable) & (wrong > least * total)

    def look(_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        every_ray = directions.smoothness(rays, rays.in_range)
        return every_ray, directions.smoothness(rays, compared.novel)

    suspicious = (updates >= CONFIDENT_UPDATES) & exceeds(_NOISE_WRONG, _LEAST_NOISE_WRONG)
    unknown = jnp.float32(directions.UNKNOWN)
    smooth, smooth_novel = run_if(suspicious, look, (unknown, unknown), rays, compared)
    noise = suspicious & (smooth != directions.UNKNOWN) & (smooth < _LEAST_SMOOTH)

    def fills_view(most_piercing: float, least_beside: float) -> jax.Array:
        return (
            (smooth_novel >= _LEAST_SMOOTH)
            & (through <= most_piercing * comparable)
            & (agreeing >= _LEAST_AGREEING * comparable)
            & (agreeing >= least_beside * (comparable - in_free))
        )

    contradicts = suspicious & exceeds(_MOST_WRONG, _LEAST_WRONG)
    contradicts &= ~fills_view(_MOST_PIERCING, _LEAST_BESIDE)

    def search(_: jax.Array) -> jax.Array:
        return is_misplaced(config, grid, some, piercing | (known & novel))

    searched = (updates >= CONFIDENT_UPDATES) & (wrong > _LEAST_MISPLACED * total)
    misplaced = run_if(searched, search, jnp.zeros((), bool), grid, some, piercing, known, novel)
    misplaced &= ~fills_view(_MOST_PIERCING_ELSEWHERE, _LEAST_BESIDE_ELSEWHERE)
    return CloudVerdict(~(contradicts | noise | misplaced), noise)
