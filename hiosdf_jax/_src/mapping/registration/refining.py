"""Refines the pose of a cloud by a map."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.field.queries import AnyField, as_field
from hiosdf_jax._src.mapping.registration.comparing import (
    GROWING_REACH_M,
    make_rows,
    take_rows,
    units,
)
from hiosdf_jax._src.mapping.registration.equations import Anchor, Directions, invert
from hiosdf_jax._src.mapping.registration.judging import judge
from hiosdf_jax._src.mapping.registration.matching import least_range_of, noise_of
from hiosdf_jax._src.mapping.registration.motion import distance_and_angle
from hiosdf_jax._src.mapping.registration.selection import (
    are_returns,
    draw_returns,
    pad_to_few_sizes,
    square_ranges_on_host,
    take_evenly_on_device,
    take_evenly_on_host,
)
from hiosdf_jax._src.mapping.registration.solving import (
    COMPLETE_REACH_M,
    MOST_STARTS,
    differentiable,
    select_rows,
    solve_coarse,
    solve_fine,
)
from hiosdf_jax._src.mapping.registration.uncertainty import covariance_of, unknown_covariance
from hiosdf_jax._src.numerics.collecting import collector_paused
from hiosdf_jax._src.numerics.intake import (
    as_array,
    as_number,
    as_traced,
    check_covariance,
    check_has_return,
    check_pose,
    check_whole,
    checked_cloud,
    is_traced,
    may_be_covariance,
)
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.rigid import is_rigid
from hiosdf_jax._src.numerics.robot_and_noise import check_extras
from hiosdf_jax._src.state.pytrees import Baked, Field

# Rows of a cloud from which the others are selected.
_CANDIDATES = 16384

_REACHES_M = 1e-3, 100.0  # least and most

# Half a turn from the mean of a prior, the direction back to it is not defined.
_MOST_TURN_RAD = 3.0


class Registration(NamedTuple):
    """A pose that was refined by a map.

    Attributes:
        pose: (4, 4) float32, T_world_sensor.
        covariance: That of the pose's error, (6, 6) float32: the translation, m, and then the
            rotation about the sensor, rad, both along the axes of the world frame. Directions that
            the cloud does not determine have a standard deviation of 100 m, or that of the prior.
        residual: Root mean square distance of the inliers from the surface, () float32, m.
        inliers: Share of the returns in observed space that lie on a surface, () float32.
        converged: The steps came to rest, and enough returns support the pose, () bool; see
            docs/registration.md. Where it is False, the other values must not be used.
    """

    pose: jax.Array
    covariance: jax.Array
    residual: jax.Array
    inliers: jax.Array
    converged: jax.Array


def refine_pose(
    field: AnyField,
    cloud: Any,
    pose: Any,
    prior: tuple[Any, Any] | None = None,
    *,
    noise: tuple[Any, Any] | None = None,
    reach_m: Any = COMPLETE_REACH_M,
    starts: int = MOST_STARTS,
) -> Registration:
    """Finds the pose near a given one at which a cloud lies on the surfaces of a map.

    Robust Gauss-Newton steps on the distances, in which outliers lose their weight. The pose may
    be 15 cm and 6 degrees off. If the cloud does not fit after these steps, others start from
    other poses. Pure: works inside `jit`, `vmap` and `lax.scan`. Differentiable by the field, the
    cloud and the prior; see docs/registration.md.

    Args:
        field: A map, a snapshot of one, or a baked field.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        pose: (4, 4) T_world_sensor, the initial pose.
        prior: (mean, covariance): a pose (4, 4) and the covariance of its error (6, 6), as in
            `Registration`, such as that of odometry. Without one, directions that the cloud does
            not determine stay as in `pose`.
        noise: (a, b) of the standard deviation a + b r^2 of a return at range r, m and 1/m. By
            default it is `Config.range_noise` of the map; of a baked field, the default's.
        reach_m: Largest distance between a return and its surface at the initial pose, 0.001 to
            100 m. The default suits a complete map. In a growing map the right surface may be
            missing and a wrong one near: `track` takes 0.2. A smaller reach also removes the weight
            of outliers sooner. Without a prior, a result farther from the initial pose than this,
            m or rad, has not converged.
        starts: Maximum number of initial poses, 1 to 5, not traced. The first is `pose`. While the
            cloud does not fit, others follow, 15 cm and 6 degrees away, or nearer with a smaller
            reach. With a prior there are two, both at `pose`, the second with less trust in the
            prior. Pass 1 to compare many poses: under `vmap` each takes as many starts as the
            worst one.

    Returns:
        The refined pose, and how far it can be trusted.

    Raises:
        ValueError: A type or shape is wrong, or `starts` is not a whole number from 1 to 5. Outside
            jit also: the pose or the prior's mean is not finite or not rigid, the prior's
            covariance is not symmetric and positive definite, the cloud has no finite row, or a
            value of `noise` or `reach_m` is out of range.

    Example:
        >>> found = hio.refine_pose(field, cloud, odometry_pose)
        >>> if found.converged:
        ...     state = hio.update(state, cloud, found.pose)
    """
    field = as_field(field)
    prior = _checked_prior(prior)
    _, checked_noise = check_extras(None, noise)
    reach = checked_reach(reach_m)
    check_whole("starts", starts, 1, MOST_STARTS)
    most = np.asarray(starts, np.int32)
    if is_traced(*jax.tree.leaves((field, prior, checked_noise, reach)), cloud, pose):
        return _refine(field, *as_traced(cloud, pose), prior, checked_noise, reach, most)
    floats = checked_cloud(cloud)
    check_has_return(floats)
    checked = check_pose(pose)
    candidates = _draw_candidates(floats, least_range_of(field))
    with collector_paused():
        return _refine_jit(field, candidates, checked, prior, checked_noise, reach, most)


def _draw_candidates(cloud: np.ndarray, least_range_m: float) -> np.ndarray | jax.Array:
    """Draws rows of a cloud (N, 3), m, so that clouds of all sizes share one compilation."""
    if jax.default_backend() != "cpu" and len(cloud) > _CANDIDATES:
        # A call takes 10 to 20 % less than with numpy. A program per size of clouds compiles fast.
        return take_evenly_on_device(pad_to_few_sizes(cloud), least_range_m, _CANDIDATES)
    some = are_returns(square_ranges_on_host(cloud), least_range_m)
    return take_evenly_on_host(cloud, some, _CANDIDATES)


@plain
def _refine(
    field: Field | Baked,
    cloud: jax.Array,
    pose: jax.Array,
    prior: tuple[jax.Array, jax.Array] | None,
    noise: jax.Array | None,
    reach_m: Any,
    starts: jax.Array | np.ndarray,
) -> Registration:
    cloud, pose = cloud.astype(jnp.float32), pose.astype(jnp.float32)
    # Replaced where it is wrong: derivatives of what is not chosen must be finite, too.
    valid = (reach_m >= _REACHES_M[0]) & (reach_m <= _REACHES_M[1])
    reach_m = jnp.where(valid, reach_m, COMPLETE_REACH_M)
    points, some = draw_returns(cloud, least_range_of(field), _CANDIDATES)
    floor, growth = noise_of(field) if noise is None else noise
    range_noise = jnp.float32(floor), jnp.float32(growth)
    growing = (COMPLETE_REACH_M - reach_m) / (COMPLETE_REACH_M - GROWING_REACH_M)
    rows = make_rows(points, some, range_noise, jnp.clip(growing, 0, 1))
    anchor = Anchor(pose, None)
    if prior is not None:
        mean, covariance = (jnp.asarray(part, jnp.float32) for part in prior)
        per_unit = 1 / units(rows)
        proper = may_be_covariance(covariance)
        valid &= proper
        covariance = jnp.where(proper, covariance, jnp.eye(6, dtype=jnp.float32))
        symmetric = (covariance + covariance.T) / 2  # of which the inverse reads one half
        anchor = Anchor(mean, per_unit[:, None] * invert(symmetric) * per_unit)

    fixed_field, fixed_rows, fixed_anchor = jax.lax.stop_gradient((field, rows, anchor))
    begin, reach_m = jax.lax.stop_gradient((pose, reach_m))
    near, share = solve_coarse(fixed_field, fixed_rows, begin, fixed_anchor, reach_m, starts)
    rows, fixed_rows = rows._replace(share=share), fixed_rows._replace(share=share)
    index, chosen, directions = select_rows(fixed_field, fixed_rows, near)
    found, residuals, rests, inflation = solve_fine(
        fixed_field, chosen, near, directions, fixed_anchor
    )
    covariance = covariance_of(residuals, directions, fixed_anchor, rows)

    verdict = judge(fixed_field, fixed_rows, found)
    is_known = jnp.all(jnp.isfinite(covariance))
    covariance = jnp.where(is_known, covariance, unknown_covariance())
    usable = valid & is_rigid(found) & is_known
    if prior is None:
        # A cloud that determines hardly anything, such as a line of returns, may turn by a radian.
        is_near = jnp.maximum(*distance_and_angle(pose, found)) <= reach_m
    else:
        usable &= is_rigid(prior[0])
        is_near = distance_and_angle(prior[0], found)[1] <= _MOST_TURN_RAD
    converged = rests & verdict.fits & usable & is_near
    own = take_rows(rows, index)._replace(share=chosen.share)
    # What is not finite would make derivatives NaN, although no such pose is chosen.
    solution, other = (anchor, found, directions, inflation), _any_solution(prior is not None)
    finite = jax.tree.map(partial(jnp.where, converged), solution, other)
    exact = differentiable(field, own, *finite)
    constant = jax.lax.stop_gradient(jnp.where(usable, found, pose))
    return Registration(
        pose=jnp.where(converged, exact, constant),
        covariance=covariance,
        residual=verdict.residual,
        inliers=verdict.inliers,
        converged=converged,
    )


def _any_solution(has_prior: bool) -> tuple[Anchor, jax.Array, Directions, jax.Array]:
    """Returns finite arguments for `differentiable`."""
    pose, axes = jnp.eye(4, dtype=jnp.float32), jnp.eye(6, dtype=jnp.float32)
    anchor = Anchor(pose, axes if has_prior else None)
    return anchor, pose, Directions(axes, jnp.zeros(6, bool)), jnp.ones((), jnp.float32)


_refine_jit = jax.jit(_refine)


def checked_reach(reach_m: Any) -> Any:
    """Checks the argument `reach_m`, of tracers only the shape, and returns it as () float32."""
    if not is_traced(reach_m):
        reach_m = as_number("reach_m", reach_m, _REACHES_M[0])
        if reach_m > _REACHES_M[1]:
            raise ValueError(f"reach_m is {reach_m}, expected at most {_REACHES_M[1]:g}")
        return np.asarray(reach_m, np.float32)
    if np.shape(reach_m) != ():
        raise ValueError(f"reach_m has shape {np.shape(reach_m)}, expected one number")
    return jnp.asarray(reach_m, jnp.float32)


def _checked_prior(prior: Any) -> tuple[jax.Array, jax.Array] | None:
    """Checks a prior, of tracers only the shapes."""
    if prior is None:
        return None
    try:
        mean, covariance = prior
    except (TypeError, ValueError):
        raise ValueError(f"prior is {prior!r}, expected (mean, covariance)") from None
    mean, covariance = as_array("prior mean", mean), as_array("prior covariance", covariance)
    shapes = np.shape(mean), np.shape(covariance)
    if shapes != ((4, 4), (6, 6)):
        raise ValueError(
            f"prior has a mean of shape {shapes[0]} and a covariance of shape {shapes[1]}, "
            "expected (4, 4) and (6, 6)"
        )
    if not is_traced(mean):
        mean = check_pose(mean, "prior")
    if not is_traced(covariance):
        check_covariance("prior covariance", np.asarray(covariance))
    return jnp.asarray(mean, jnp.float32), jnp.asarray(covariance, jnp.float32)
