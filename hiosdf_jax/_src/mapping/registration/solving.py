"""Finds the pose at which a cloud fits a map: coarse steps with many outliers, then fine ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.registration.comparing import (
    Residuals,
    Rows,
    Sums,
    compare,
    even_index,
    information_of,
    no_sums,
    slope_of,
    sum_returns,
    take_evenly,
    take_rows,
    tolerate,
    units,
)
from hiosdf_jax._src.mapping.registration.equations import (
    Anchor,
    Directions,
    Fit,
    balance,
    find_directions,
    find_step,
    fit_of,
    fits_better,
)
from hiosdf_jax._src.mapping.registration.matching import share_of_map
from hiosdf_jax._src.mapping.registration.motion import distance_and_angle, motion_between, move
from hiosdf_jax._src.mapping.registration.selection import draw_informative
from hiosdf_jax._src.mapping.registration.uncertainty import inflation_of
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.loops import rounds_per_step
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.small_matrices import product
from hiosdf_jax._src.numerics.tangents import all_zero, instantiate
from hiosdf_jax._src.state.pytrees import Baked, Field

# Surfaces may be this far from where they should be in the last coarse step, m. Fewer steps do not
# suffice along directions in which few returns tell anything.
_COARSE_END_M = 0.02
_COARSE_STEPS = 24
_DAMPING = 1e-5

# Where the returns have more than this mean loss after the coarse steps, they may have come to a
# wrong minimum. Most right poses of held-out frames have 0.016 to 0.02, wrong ones 0.04 to 0.2.
_MOST_LOSS = 0.03
_LEAST_KNOWN = 0.3  # share of the returns that the map must be able to judge

# Then the steps begin again, this far from the given pose, m and rad, in directions to the corners
# of tetrahedra. Of 210 poses in the apartment, 15 cm and 6 degrees off, one start loses 7, and five
# lose none.
_OTHER_DISTANCE_M = 0.15
_OTHER_ANGLE_RAD = 0.105
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
_FARTHEST = 2.0  # times that distance and angle: other starts that end farther off are not kept
_OTHER_STARTS = np.concatenate(
    [_OTHER_DISTANCE_M * _CORNERS, _OTHER_ANGLE_RAD * np.roll(-_CORNERS, 1, axis=0)], axis=1
).astype(np.float32)

# This many returns count as one independent return. Against a prior, coarse steps must not trust
# them more: noisy normals seem to constrain directions that the surfaces do not constrain.
_COARSE_INFLATION = 16.0

# A tolerance lowers the information of returns about as if they were this exact without it, m. In
# the second start with a prior, that of the prior is lowered alike. Otherwise the first steps keep
# a pose that is three of its deviations off, and the last ones find a wrong minimum there. The
# second result is kept if the mean loss, as `fits_better` counts it, is lower by more than this, up
# to this many deviations from the prior. In a house, where a third of each frame is new, the second
# search lowered the loss of right first results by up to 0.005, and a wrong second result bends the
# map. In a room where few returns determine a direction, it lowered that of wrong first results by
# 0.01 to 0.05.
_COARSE_SIGMA_M = 0.02
_LEAST_GAIN = 0.01
_MOST_DEVIATIONS = 6.0

# Rows are selected where surfaces may be this far off, m: those that contradict a pose that is not
# yet right must be among them. Fine steps begin with a smaller tolerance, m, and shrink it by a
# factor in each step.
_SELECTED_M = 0.1
_FINE_START_M = 0.04
_FINE_SHRINK = 0.6
_FINE_END_M = 0.004  # no tolerance below

# The distance has kinks, around which whole steps may jump for ever: in a fifth of the frames of a
# house, by up to 5 mm. So the steps after the whole ones take a half, a third, and so on.
_FINE_STEPS = 24
_WHOLE_STEPS = 16

# With earlier code, the median error on held-out frames of a house, 5 cm and 3 degrees off, was
# 0.27 cm and 0.047 degrees. It was 0.29 cm and 0.051 degrees with 3,072 rows, and 0.28 cm and 0.047
# degrees with 8,192.
_FINE_ROWS = 4096

# Steps end once one is shorter than this, m. Poses are then 0.01 mm from where they would rest.
_FINISHED_M = 5e-5

# Whether one is so short is asked after this many steps: on a GPU the answer takes as long as a
# step. A pose also rests if the mean vector of the last so many whole steps is at most this long,
# m. Single ones may be longer, if they jump to and fro, but not longer than the second value: none
# around a kink was.
_STEPS_AT_ONCE = 4
_RESTING_M = 2e-3
_LONGEST_JUMP_M = 0.01

COMPLETE_REACH_M = 0.7
"""How far surfaces may be from where they should be, in a complete map."""

MOST_STARTS = 1 + len(_OTHER_STARTS)
"""Poses from which coarse steps can begin."""


def solve_coarse(
    field: Field | Baked,
    rows: Rows,
    pose: jax.Array,
    anchor: Anchor,
    reach_m: jax.Array | float,
    starts: jax.Array | np.ndarray | int = 1,
) -> tuple[jax.Array, jax.Array]:
    """Brings a pose near the solution, with a tolerance that shrinks from step to step.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4), where to begin.
        anchor: What holds free directions.
        reach_m: How far surfaces may be from where they should be in the first step.
        starts: Most poses to begin from. Others around the given one are tried as long as the
            returns do not fit. With a prior there are at most two. Both are the given pose, and the
            second one trusts the prior less.

    Returns:
        The pose (4, 4) at which the returns fit best, and `Rows.share` as measured before the last
        step to it.
    """
    few = take_evenly(rows)
    shrink = _COARSE_END_M / reach_m
    size = jnp.minimum(reach_m / COMPLETE_REACH_M, 1)
    motions = size * jnp.concatenate([jnp.zeros((1, 6), jnp.float32), _OTHER_STARTS])
    has_prior = anchor.information is not None
    if has_prior:
        motions, starts = jnp.zeros((2, 6), jnp.float32), jnp.minimum(starts, 2)
    unknown = Fit(jnp.float32(jnp.inf), jnp.float32(0))

    def step(
        number: jax.Array, i: jax.Array, carry: tuple[jax.Array, Sums]
    ) -> tuple[jax.Array, Sums]:
        pose, before = carry
        scale_m = reach_m * shrink ** (jnp.float32(i) / (_COARSE_STEPS - 1))
        # The first step takes planes, which narrow patches have, too.
        sums = sum_returns(field, few._replace(share=before.share), pose, scale_m)
        softer = anchor
        if softer.information is not None:
            lower = jnp.where(number > 0, 1 + (scale_m / _COARSE_SIGMA_M) ** 2, 1)
            softer = softer._replace(information=softer.information / lower)
        # Fine steps bring free directions back.
        motion = find_step(sums, None, softer, few, pose, _COARSE_INFLATION, _DAMPING)
        return move(pose, motion), sums

    def begin(carry: tuple[Any, Fit, jax.Array]) -> tuple[Any, Fit, jax.Array]:
        best, least, number = carry
        start = move(pose, motions[number]), no_sums()
        found, sums = jax.lax.fori_loop(
            0, _COARSE_STEPS, partial(step, number), start, unroll=rounds_per_step(_COARSE_STEPS)
        )
        fit = fit_of(sums, few.some)
        if anchor.information is None:
            distance, angle = distance_and_angle(pose, found)
            most = _FARTHEST * size
            near = (distance <= most * _OTHER_DISTANCE_M) & (angle <= most * _OTHER_ANGLE_RAD)
        else:
            away = units(few) * motion_between(anchor.pose, found)
            near = jnp.sum(away * product(anchor.information, away)) <= _MOST_DEVIATIONS**2
        usable = jnp.all(jnp.isfinite(found)) & ((number == 0) | near)
        fit = fit._replace(loss=jnp.where(usable, fit.loss, jnp.inf))
        better = (number == 0) | fits_better(fit, least, _LEAST_GAIN if has_prior else 0.0)
        pick = partial(jnp.where, better)
        result = found, sums.share
        return *jax.tree.map(pick, (result, fit), (best, least)), number + 1

    def continues(carry: tuple[Any, Fit, jax.Array]) -> jax.Array:
        _, least, number = carry
        fits = (least.loss <= _MOST_LOSS) & (least.known >= _LEAST_KNOWN)
        return (number < starts) & (has_prior | ~fits)

    first = (pose, few.share), unknown, jnp.int32(0)
    return jax.lax.while_loop(continues, begin, first)[0]


class Selection(NamedTuple):
    """The returns for the fine steps.

    Attributes:
        index: Their numbers among all rows, (K,) int32.
        rows: The rows; they lie on narrower patches than others, so their share is measured again.
        directions: Principal directions of all returns.
    """

    index: jax.Array
    rows: Rows
    directions: Directions


def select_rows(field: Field | Baked, rows: Rows, pose: jax.Array) -> Selection:
    """Selects the returns that determine the pose best, for the fine steps.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4), near the solution.

    Returns:
        At most as many returns as fine steps use, all if there are no more.
    """
    here = compute_once(compare(field, rows, pose, 0.0))
    even = even_index(rows)
    directions = find_directions(
        field, take_rows(rows, even), pose, jax.tree.map(lambda part: part[even], here)
    )
    index = _most_informative(tolerate(here, rows, _SELECTED_M), rows, directions)
    width = here.width[index]
    share = share_of_map(jnp.sum(width), jnp.sum(width > 0))
    return Selection(index, take_rows(rows, index)._replace(share=share), directions)


def _most_informative(residuals: Residuals, rows: Rows, directions: Directions) -> jax.Array:
    """Draws the numbers of the rows that determine the pose best, (K,) int32."""
    whole = jnp.arange(min(_FINE_ROWS, len(rows.some)), dtype=jnp.int32)
    if len(rows.some) <= _FINE_ROWS:
        return whole
    information = information_of(residuals)
    # Free directions must not draw all rows.
    stiffness = jnp.where(directions.free, jnp.trace(information), 0)
    information += product(directions.basis * stiffness, directions.basis.T)
    information += 1e-9 * (1 + jnp.trace(information)) * jnp.eye(6, dtype=jnp.float32)
    row = draw_informative(residuals.jacobian, residuals.weight, information, _FINE_ROWS)
    # A small cloud that is padded gives the same pose as without padding.
    return jnp.where(jnp.sum(rows.some) <= _FINE_ROWS, whole, row)


class Solution(NamedTuple):
    """A pose that fine steps have found.

    Attributes:
        pose: (4, 4).
        residuals: The returns at this pose.
        rests: The steps have come to rest, () bool.
        inflation: How many returns are worth one independent return, ().
    """

    pose: jax.Array
    residuals: Residuals
    rests: jax.Array
    inflation: jax.Array


def solve_fine(
    field: Field | Baked, rows: Rows, pose: jax.Array, directions: Directions, anchor: Anchor
) -> Solution:
    """Steps until the pose stays where it is.

    A prior counts by its covariance, so returns must not count as independent of each other. How
    much they depend on each other is measured where the first steps end. Then the pose is solved
    again.

    Args:
        field: The map.
        rows: The returns.
        pose: (4, 4), near the solution.
        directions: Principal directions, some of them free.
        anchor: What holds free directions.

    Returns:
        The solution.
    """
    one = jnp.ones((), jnp.float32)

    def solve(inflation: jax.Array, pose: jax.Array, start_m: jax.Array | float) -> Solution:
        found, rests = _rest(field, rows, pose, inflation, directions, anchor, start_m)
        return Solution(found, compare(field, rows, found, 0.0), rests, inflation)

    if anchor.information is None:
        return solve(one, pose, _FINE_START_M)

    def solve_again(number: jax.Array, found: Solution) -> Solution:
        again = number > 0
        inflation = jnp.where(again, inflation_of(found.residuals, directions), one)
        return solve(inflation, found.pose, jnp.where(again, 0, _FINE_START_M))

    start = Solution(pose, _no_residuals(field, rows, pose), jnp.zeros((), bool), one)
    return jax.lax.fori_loop(0, 2, solve_again, start)


def _no_residuals(field: Field | Baked, rows: Rows, pose: jax.Array) -> Residuals:
    """Returns zeros in the shapes of residuals."""
    shapes = jax.eval_shape(compare, field, rows, pose, jnp.float32(0))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


class _Progress(NamedTuple):
    """Fine steps so far.

    Attributes:
        pose: (4, 4).
        last_m: Length of the last whole step, () m; infinite as long as there is a tolerance.
        total: Sum of the whole steps since the last check for rest, (6,).
        longest_m: Length of the longest of these steps, () m.
        count: Number of steps, () int32.
    """

    pose: jax.Array
    last_m: jax.Array
    total: jax.Array
    longest_m: jax.Array
    count: jax.Array


def _rest(
    field: Field | Baked,
    rows: Rows,
    pose: jax.Array,
    inflation: jax.Array,
    directions: Directions,
    anchor: Anchor,
    start_m: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Steps until a pose rests, with surfaces up to `start_m` off in the first step.

    Returns:
        The pose (4, 4), and whether it rests, () bool.
    """
    nothing = jnp.zeros(6, jnp.float32)

    def length_m(motion: jax.Array) -> jax.Array:
        return jnp.linalg.norm(motion[:3]) + rows.length * jnp.linalg.norm(motion[3:])

    def step(_: jax.Array, now: _Progress) -> _Progress:
        scale_m = start_m * _FINE_SHRINK ** now.count.astype(jnp.float32)
        sums = sum_returns(field, rows, now.pose, jnp.where(scale_m > _FINE_END_M, scale_m, 0))
        motion = find_step(sums, directions, anchor, rows, now.pose, inflation)
        part = 1 / jnp.maximum(now.count - _WHOLE_STEPS + 2, 1).astype(jnp.float32)
        step_m = length_m(motion)
        return _Progress(
            pose=move(now.pose, part * motion),
            # Exact comparisons alone say whether a pose rests.
            last_m=jnp.where(scale_m > _FINE_END_M, jnp.inf, step_m),
            total=now.total + motion,
            longest_m=jnp.maximum(now.longest_m, step_m),
            count=now.count + 1,
        )

    def steps(now: _Progress) -> _Progress:
        now = now._replace(total=nothing, longest_m=jnp.float32(0))
        return jax.lax.fori_loop(
            0, _STEPS_AT_ONCE, step, now, unroll=rounds_per_step(_STEPS_AT_ONCE)
        )

    def continues(now: _Progress) -> jax.Array:
        return (now.count < _FINE_STEPS) & (now.last_m > _FINISHED_M)

    start = _Progress(pose, jnp.float32(jnp.inf), nothing, jnp.float32(0), jnp.int32(0))
    end = jax.lax.while_loop(continues, steps, start)
    slow = length_m(end.total) <= _STEPS_AT_ONCE * _RESTING_M
    return end.pose, (end.last_m <= _FINISHED_M) | (slow & (end.longest_m <= _LONGEST_JUMP_M))


@jax.custom_jvp
def differentiable(
    field: Field | Baked,
    rows: Rows,
    anchor: Anchor,
    pose: jax.Array,
    directions: Directions,
    inflation: jax.Array,
) -> jax.Array:
    """Gives a solution its derivatives by the map, the returns and the anchor.

    At the solution a balance is zero, and stays so when they change (implicit differentiation). The
    steps that led there are not differentiated. Which rows are used and which directions are free
    is held fixed.

    Args:
        field: The map.
        rows: The returns.
        anchor: What holds free directions.
        pose: (4, 4), the solution.
        directions: Principal directions, some of them free.
        inflation: As in `Solution`.

    Returns:
        The pose.
    """
    # `jax.lax.custom_root` does the same, but jax 0.11 takes 1 ms longer to start what contains it.
    return pose


@partial(differentiable.defjvp, symbolic_zeros=True)
@plain
def _(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    *given, pose, directions, inflation = primals
    # In second derivatives the pose itself has derivatives.
    pose = differentiable(*given, pose, directions, inflation)
    still = jnp.zeros(6, jnp.float32)

    def unbalance(motion: jax.Array, given: Sequence[Any]) -> jax.Array:
        field, rows, anchor = given
        moved = move(pose, motion)
        slope = slope_of(compare(field, rows, moved, 0.0)) / inflation
        return balance(directions, slope, anchor, rows, moved)

    def change_by(k: int) -> jax.Array:
        def by_one(value: Any) -> jax.Array:
            return unbalance(still, [*given[:k], value, *given[k + 1 :]])

        return jax.jvp(by_one, (given[k],), (instantiate(given[k], tangents[k]),))[1]

    change = sum((change_by(k) for k in range(3) if not all_zero(tangents[k])), start=still)
    matrix = jax.jacfwd(unbalance)(still, given)
    # Rows of free directions are many orders smaller than others.
    size = 1 / jnp.maximum(jnp.max(jnp.abs(matrix), axis=1), 1e-12)
    inverse = jnp.linalg.inv(size[:, None] * matrix)
    # Where nothing determines the pose, it has no derivatives.
    inverse = jnp.where(jnp.all(jnp.isfinite(inverse)), inverse, 0)
    motion = -product(inverse, size * change)
    return jax.jvp(partial(move, pose), (still,), (motion,))
