"""Finds the pose of a cloud in a map without any guess: from many hypotheses to a few, to the best.

Hypotheses lie in free space, upright, and turned by any angle about the vertical. All are scored
with few returns. Two rounds move the better ones a little at random and score them with more
returns. The best of them are brought near a solution by coarse steps, and the best four places are
refined.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.queries import AnyField, as_field
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.mapping.registration.comparing import (
    Rows,
    compare,
    make_rows,
    measure_share,
    take_evenly,
)
from hiosdf_jax._src.mapping.registration.equations import Anchor
from hiosdf_jax._src.mapping.registration.matching import least_range_of, noise_of
from hiosdf_jax._src.mapping.registration.motion import distance_and_angle, rotation_of
from hiosdf_jax._src.mapping.registration.refining import Registration, refine_pose
from hiosdf_jax._src.mapping.registration.selection import draw_evenly, draw_returns
from hiosdf_jax._src.mapping.registration.solving import COMPLETE_REACH_M, solve_coarse
from hiosdf_jax._src.numerics.intake import (
    as_array,
    as_key,
    as_traced,
    check_whole,
    cloud_and_returns,
    is_traced,
)
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.small_matrices import product
from hiosdf_jax._src.numerics.vectors import dot, each, split
from hiosdf_jax._src.state.pytrees import Baked, Field

# A sensor is at least this far from surfaces, m.
_CLEARANCE_M = 0.15

# By default there is one hypothesis per this many voxels, within these limits. In a furnished hall
# with 7,000 m3 of free space 0.5 million find 87 of 89 places, 2 million 85 to 88, 4 million all.
_VOXELS_EACH = 4
_LEAST_HYPOTHESES, _MOST_HYPOTHESES = 2**16, 2**22

# Hypotheses are scored with this many returns. One that lies this far from a surface counts half.
_FIRST_ROWS = 64
_LOOSE_M = 0.3
_AT_ONCE = 4096


class _Round(NamedTuple):
    """Replaces the best hypotheses, one in `one_in` of all, by the best of their moved copies."""

    one_in: int
    rows: int  # returns that score the copies
    shift_m: float  # standard deviations of the random moves
    turn_rad: float


_ROUNDS = _Round(64, 128, 0.4, 0.1), _Round(512, 256, 0.2, 0.05)
_COPIES = 16

# The best hypotheses, and the returns by which they are brought near a solution.
_KEPT = 256
_KEPT_ROWS = 256
_KEPT_AT_ONCE = 32
_PLACES = 4

# Final scores: a return within this distance lies on a surface, m.
_SCORED_ROWS = 2048
_FITS_M = 0.05

# A place is sure if its score exceeds that of any other place by this.
_SURE_MARGIN = 0.1

# Poses within this many meters and radians of each other are one place.
_PLACE_M, _PLACE_RAD = 0.5, 0.3


class Relocalization(NamedTuple):
    """Where a cloud fits a map, and where else.

    Attributes:
        best: The pose at which the cloud fits best.
        score: Share of the cloud's returns that lie within 5 cm of a surface there, () float32.
        other: The best pose at another place, at least 0.5 m or 17 degrees away. If there is none,
            `best` again.
        other_score: The same share there, or 0, () float32. If it is close to `score`, the place is
            ambiguous.
    """

    best: Registration
    score: jax.Array
    other: Registration
    other_score: jax.Array

    @property
    def sure(self) -> jax.Array:
        """Whether `best` has converged and fits clearly better than another place, () bool."""
        return self.best.converged & (self.score > self.other_score + _SURE_MARGIN)


def relocalize(
    field: AnyField,
    cloud: Any,
    key: jax.Array,
    hypotheses: int | None = None,
    *,
    up_sensor: Any = (0.0, 0.0, 1.0),
    up_world: Any = (0.0, 0.0, 1.0),
) -> Relocalization:
    """Finds the pose of a cloud in a map without a prior.

    Robots know gravity, from an accelerometer or their mounting: hypotheses are upright, at random
    points of observed free space, and turned by any angle about the vertical. A tilt that is 3
    degrees off does no harm. Pure: works inside `jit` and `vmap`.

    Args:
        field: A map, a snapshot of one, or a baked field.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        key: Source of the hypotheses, from `jax.random.key`.
        hypotheses: How many random poses are tried, at least 256. The default is one per 4 voxels
            of the map, from 65,536 to 4,194,304.
        up_sensor: The direction against gravity in the sensor's frame, (3,). A level camera whose y
            points down has (0, -1, 0).
        up_world: The direction against gravity in the map's frame, (3,).

    Returns:
        The best pose, and the best one at another place. Trust the best one if `sure` is True: it
        has converged, and its score exceeds the other one's by 0.1.

    Raises:
        ValueError: A type or shape is wrong, or `hypotheses` is too small. Outside jit also: the
            cloud has no finite row, or a direction is zero or not finite.

    Example:
        >>> place = hio.relocalize(hio.load("map.npz"), cloud, jax.random.key(0))
        >>> if place.sure:
        ...     pose = place.best.pose
    """
    field = as_field(field)
    if hypotheses is None:
        hypotheses = _hypotheses_for(field)
    check_whole("hypotheses", hypotheses, _KEPT)
    key = as_key("key", key)
    ups = [_direction("up_sensor", up_sensor), _direction("up_world", up_world)]
    traced = is_traced(*jax.tree.leaves((field, key)), cloud, *ups)
    if traced:
        cloud, _ = as_traced(cloud, jnp.eye(4, dtype=jnp.float32))
    else:
        cloud, _ = cloud_and_returns(cloud)
    points, some = _draw(cloud, least_range_of(field))
    poses = _find_places(field, points, some, key, *ups, hypotheses)
    if traced:
        refined = jax.lax.map(lambda pose: refine_pose(field, cloud, pose, starts=1), poses)
    else:  # one compilation, that of every other call
        each = [refine_pose(field, cloud, pose, starts=1) for pose in poses]
        refined = jax.tree.map(lambda *parts: jnp.stack(parts), *each)
    return _choose(field, points, some, refined)


def _direction(name: str, vector: Any) -> Any:
    array = as_array(name, vector)
    if np.shape(array) != (3,):
        raise ValueError(f"{name} has shape {np.shape(array)}, expected (3,)")
    if is_traced(array):
        return array
    exact = np.asarray(array, float)
    length = np.linalg.norm(exact)
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"{name} is {vector!r}, expected a direction: finite and not zero")
    return (exact / length).astype(np.float32)


@jax.jit(static_argnums=1)
@plain
def _draw(cloud: jax.Array, least_range_m: float) -> tuple[jax.Array, jax.Array]:
    """Draws as many returns as scores need; fewer are padded, so that all clouds have one shape."""
    points, some = draw_returns(cloud, least_range_m, _SCORED_ROWS)
    missing = _SCORED_ROWS - some.shape[0]
    return jnp.pad(points, ((0, missing), (0, 0))), jnp.pad(some, (0, missing))


@jax.jit(static_argnums=6)
@plain
def _find_places(
    field: Field | Baked,
    points: jax.Array,
    some: jax.Array,
    key: jax.Array,
    up_sensor: jax.Array,
    up_world: jax.Array,
    hypotheses: int,
) -> jax.Array:
    """Finds poses at different places, the best first, (PLACES, 4, 4)."""
    up = up_world / jnp.linalg.norm(up_world)
    level = _turn_onto(up_sensor / jnp.linalg.norm(up_sensor), up)

    def pose_of(at: _Upright) -> jax.Array:
        turn = product(rotation_of(at.angle_rad * up), level)
        return jnp.eye(4, dtype=jnp.float32).at[:3, :3].set(turn).at[:3, 3].set(at.position_world)

    starts = _search(field, jnp.where(some[:, None], points, jnp.nan), key, pose_of, hypotheses)
    rows = _rows(field, points, some)
    fewer = take_evenly(rows, _KEPT_ROWS)

    def improve(start: jax.Array) -> tuple[jax.Array, jax.Array]:
        fixed_field, fixed_rows, begin = jax.lax.stop_gradient((field, fewer, start))
        pose, share = solve_coarse(
            fixed_field, fixed_rows, begin, Anchor(begin, None), COMPLETE_REACH_M
        )
        pose = jnp.where(jnp.all(jnp.isfinite(pose)), pose, start)
        return pose, _score(field, rows._replace(share=share), pose)

    poses, scores = jax.lax.map(improve, starts, batch_size=_KEPT_AT_ONCE)
    chosen = []
    for _ in range(_PLACES):
        best = jnp.argmax(scores)
        chosen.append(poses[best])
        scores = jnp.where(_same_place(poses[best], poses), -1, scores)
    return jnp.stack(chosen)


def _search(
    field: Field | Baked,
    points: jax.Array,
    key: jax.Array,
    pose_of: Callable[[_Upright], jax.Array],
    hypotheses: int,
) -> jax.Array:
    """Finds the poses where returns lie near surfaces, the best first, (KEPT, 4, 4)."""
    cells = _cells_of(field)
    costs = _costs(cells)
    place_key, turn_key, *round_keys = jax.random.split(key, 2 + len(_ROUNDS))

    def score(tried: _Upright, rows: int) -> jax.Array:
        few, some = draw_evenly(points, rows)

        def cost(at: _Upright) -> jax.Array:
            return jnp.sum(jnp.where(some, _look_up(cells, costs, pose_of(at), few), 0))

        return jax.lax.map(cost, tried, batch_size=_AT_ONCE)

    angles = jax.random.uniform(turn_key, (hypotheses,), jnp.float32, maxval=2 * jnp.pi)
    tried = _Upright(_draw_free(cells, place_key, hypotheses), angles)
    costs_of_tried = score(tried, _FIRST_ROWS)
    for a_round, round_key in zip(_ROUNDS, round_keys, strict=True):
        count = max(_KEPT, hypotheses // a_round.one_in)
        copies = _copy(_best(tried, costs_of_tried, count), a_round, round_key)
        flat = _Upright(copies.position_world.reshape(-1, 3), copies.angle_rad.ravel())
        costs_of_copies = score(flat, a_round.rows).reshape(count, _COPIES)
        best = jnp.arange(count), jnp.argmin(costs_of_copies, axis=1)
        tried = _Upright(copies.position_world[best], copies.angle_rad[best])
        costs_of_tried = jnp.min(costs_of_copies, axis=1)
    return jax.vmap(pose_of)(_best(tried, costs_of_tried, _KEPT))


def _best(tried: _Upright, costs: jax.Array, count: int) -> _Upright:
    _, kept = jax.lax.top_k(-costs, count)
    return jax.tree.map(lambda part: part[kept], tried)


def _copy(tried: _Upright, a_round: _Round, key: jax.Array) -> _Upright:
    """Moves copies of hypotheses at random; the first copy stays, (N, COPIES, ...)."""
    count = len(tried.angle_rad)
    shift_key, turn_key = jax.random.split(key)
    shift = a_round.shift_m * jax.random.normal(shift_key, (count, _COPIES, 3), jnp.float32)
    turn = a_round.turn_rad * jax.random.normal(turn_key, (count, _COPIES), jnp.float32)
    return _Upright(
        tried.position_world[:, None] + shift.at[:, 0].set(0),
        tried.angle_rad[:, None] + turn.at[:, 0].set(0),
    )


@jax.jit
@plain
def _choose(
    field: Field | Baked, points: jax.Array, some: jax.Array, refined: Registration
) -> Relocalization:
    """Chooses the best two of refined poses that are not at one place."""
    rows = _rows(field, points, some)

    def score(pose: jax.Array) -> jax.Array:
        return _score(field, measure_share(field, rows, pose), pose)

    scores = jax.lax.map(score, refined.pose)
    best = jnp.argmax(scores)
    elsewhere = jnp.where(_same_place(refined.pose[best], refined.pose), 0, scores)
    other = jnp.argmax(elsewhere)

    def take(index: jax.Array) -> Registration:
        return jax.tree.map(lambda part: part[index], refined)

    return Relocalization(take(best), scores[best], take(other), elsewhere[other])


class _Upright(NamedTuple):
    """Where an upright sensor is, and by how much it is turned about the vertical."""

    position_world: jax.Array  # (..., 3) m
    angle_rad: jax.Array  # (...)


class _Cells(NamedTuple):
    """The map in cells: voxels, or the surroundings of samples."""

    corner_world: jax.Array  # of the first cell, m
    size: jax.Array | float  # m
    distance: jax.Array  # (X, Y, Z) m, of the centers
    seen: jax.Array  # (X, Y, Z) bool


def _cells_of(field: Field | Baked) -> _Cells:
    if isinstance(field, Baked):
        corner_world = field.corner_world - field.resolution / 2
        return _Cells(corner_world, field.resolution, field.sdf, field.frontier > 0)
    config, derived = field.config, field.surface.derived
    corner_world = jnp.asarray(config.corner_index, jnp.float32) * config.voxel_size
    distance = derived.sdf.astype(jnp.float32)
    return _Cells(corner_world, config.voxel_size, distance, derived.frontier_steps > 0)


def _hypotheses_for(field: Field | Baked) -> int:
    voxels = field.sdf.size if isinstance(field, Baked) else math.prod(field.config.grid_shape)
    return min(max(voxels // _VOXELS_EACH, _LEAST_HYPOTHESES), _MOST_HYPOTHESES)


def _costs(cells: _Cells) -> jax.Array:
    """What a return costs that lies in a cell, from 0 to 1, (X, Y, Z)."""
    square = cells.distance**2
    return jnp.where(cells.seen, square / (square + _LOOSE_M**2), 1)


def _look_up(cells: _Cells, costs: jax.Array, pose: jax.Array, points: jax.Array) -> jax.Array:
    """Reads the costs of returns (N, 3) of a sensor at a pose, (N,); outside the map 1.

    Axis by axis: on a CPU six times as fast as with points in rows.
    """
    point = split(points)
    offset = each(lambda axis: dot(point, split(axis)), pose[:3, :3])
    world = each(jnp.add, offset, pose[:3, 3])
    cell = each(lambda w, corner: jnp.floor((w - corner) / cells.size), world, cells.corner_world)
    x, y, z = each(lambda c, n: (c >= 0) & (c < n), cell, costs.shape)
    inside = x & y & z
    index = each(lambda c: jnp.where(inside, c, 0).astype(jnp.int32), cell)
    flat = geometry.flat_index(costs.shape, index)
    return jnp.where(inside, costs.ravel().at[flat].get(mode="promise_in_bounds"), 1)


def _draw_free(cells: _Cells, key: jax.Array, count: int) -> jax.Array:
    """Draws points of free space that was observed, (count, 3) m; of the box, if there is none."""
    free = (cells.seen & (cells.distance > _CLEARANCE_M)).ravel()
    free = jnp.where(jnp.any(free), free, True)
    rank = jnp.cumsum(free, dtype=jnp.int32)
    cell_key, offset_key = jax.random.split(key)
    wanted = jax.random.randint(cell_key, (count,), 0, rank[-1], jnp.int32)
    index = geometry.unflatten(cells.seen.shape, jnp.searchsorted(rank, wanted + 1))
    offset = jax.random.uniform(offset_key, (count, 3), jnp.float32)
    return cells.corner_world + (jnp.stack(index, axis=-1) + offset) * cells.size


def _turn_onto(start: jax.Array, end: jax.Array) -> jax.Array:
    """The smallest rotation from one unit vector to another, (3, 3)."""
    cosine = jnp.sum(start * end)
    axis = jnp.cross(start, end)
    # Opposite vectors: half a turn about any axis across them.
    across = jnp.cross(start, jnp.eye(3, dtype=jnp.float32)[jnp.argmin(jnp.abs(start))])
    opposite = cosine < -0.9999
    axis = jnp.where(opposite, across, axis)
    sine = jnp.linalg.norm(axis)
    angle = jnp.where(opposite, jnp.pi, jnp.arctan2(sine, cosine))
    return rotation_of(angle * axis / jnp.maximum(sine, 1e-9))


def _rows(field: Field | Baked, points: jax.Array, some: jax.Array) -> Rows:
    floor, growth = noise_of(field)
    return make_rows(points, some, (jnp.float32(floor), jnp.float32(growth)))


def _score(field: Field | Baked, rows: Rows, pose: jax.Array) -> jax.Array:
    """The share of returns that lie on a surface."""
    seen = compare(field, rows, pose, 0.0)
    fits = seen.comparable & (jnp.abs(seen.distance) < _FITS_M)
    return jnp.sum(fits) / jnp.maximum(jnp.sum(rows.some), 1)


def _same_place(pose: jax.Array, poses: jax.Array) -> jax.Array:
    """Whether poses (N, 4, 4) are near one, (N,) bool; one that is not finite is nowhere."""
    distance, angle = distance_and_angle(pose, poses)
    return ~((distance > _PLACE_M) | (angle > _PLACE_RAD))
