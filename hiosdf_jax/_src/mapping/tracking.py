"""Maps a stream whose poses are only predicted: each is refined by the map before the update."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.change.consistency import CONFIDENT_UPDATES
from hiosdf_jax._src.mapping.pipeline import check_and_pad, run_update
from hiosdf_jax._src.mapping.registration.comparing import GROWING_REACH_M
from hiosdf_jax._src.mapping.registration.motion import distance_and_angle
from hiosdf_jax._src.mapping.registration.refining import (
    Registration,
    checked_reach,
    refine_pose,
)
from hiosdf_jax._src.mapping.registration.uncertainty import unknown_covariance
from hiosdf_jax._src.numerics.arrays import on_device
from hiosdf_jax._src.numerics.intake import as_array, as_traced, check_pose, is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.robot_and_noise import (
    check_extras,
    leave_out_robot,
    leave_out_robot_on_host,
)
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import MapState, Report

# How far a pose may be moved from its prediction, as a share of `reach_m`, m and rad.
_MOST_MOVED = 2.0

# The standard deviation of a prediction without a prior, as a share of `reach_m`, m and rad.
_PREDICTED_DEVIATION = 0.25


def track(
    state: MapState,
    cloud: Any,
    predicted_pose: Any,
    prior: tuple[Any, Any] | None = None,
    *,
    donate: bool = False,
    robot: tuple[Any, Any] | None = None,
    noise: tuple[Any, Any] | None = None,
    reach_m: Any = GROWING_REACH_M,
) -> tuple[MapState, Registration]:
    """Refines the predicted pose of a cloud by the map so far, and fuses the cloud there.

    It is `refine_pose` and then `update`. A cloud that fits at no pose near the predicted one is
    not fused: the map stays as it was, and `Flag.NOT_REGISTERED` is raised. The first cloud of a
    map is fused where it is predicted. So are those of the next four updates that do not fit, since
    a young map cannot judge them; they raise `Flag.FUSED_AS_PREDICTED`.
    Pure: works inside `jit`, `vmap` and `lax.scan`.

    Args:
        state: The map so far.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are ignored.
        predicted_pose: (4, 4) T_world_sensor, a few centimeters and degrees off; for instance from
            `predict_pose`.
        prior: As for `refine_pose`. By default the predicted pose, with a standard deviation of a
            quarter of `reach_m`: 5 cm and 2.9 degrees.
        donate: As for `update`.
        robot: (centers, radii) as for `update`, with the centers placed by `predicted_pose`.
            Returns on the robot do not count for the registration. The spheres move with the pose.
        noise: As for `update`.
        reach_m: As for `refine_pose`. A pose that is farther than twice this from the prediction,
            m or rad, is refused.

    Returns:
        The new map, and the registration. `converged` is False if the map did not determine the
        pose, even where the cloud was fused as predicted. Then the pose is the predicted one, and
        the covariance that of the prior, or 100 m. The first cloud defines where the map is: if
        `update` takes it, `converged` is True, and the covariance that of the prior, or 0.

    Raises:
        ValueError: As `refine_pose` and `update` do.

    Example:
        >>> state, last = hio.track(state, clouds[0], odometry[0])
        >>> reference = 0  # the last registered frame
        >>> for i in range(1, len(clouds)):
        ...     predicted = hio.predict_pose(last.pose, odometry[reference], odometry[i])
        ...     state, found = hio.track(state, clouds[i], predicted)
        ...     if found.converged:
        ...         last, reference = found, i
    """
    check_map(state, batched="jax.vmap(hio.track)(maps, clouds, poses)")
    checked_robot, checked_noise = check_extras(robot, noise)
    reach = checked_reach(reach_m)
    traced = is_traced(*jax.tree.leaves((state, prior, checked_robot, checked_noise, reach)))
    traced = traced or is_traced(cloud, predicted_pose)
    only_robot = False
    noise_now = state.config.range_noise if checked_noise is None else checked_noise
    if traced:
        cloud, pose = as_traced(cloud, predicted_pose)
        fused_cloud, start = cloud, pose
        if checked_robot is not None:
            cloud = leave_out_robot(cloud, pose, checked_robot, noise_now)
    else:
        if checked_robot is not None:
            # Before rows are drawn: few of them may be off the robot.
            cloud, only_robot = leave_out_robot_on_host(
                cloud, predicted_pose, checked_robot, noise_now
            )
        padded, pose = check_and_pad(cloud, predicted_pose, state.config.max_points)
        fused_cloud, start = jax.device_put((padded, pose))
    chosen = prior_of_prediction(pose, reach) if prior is None else prior
    found = refine_pose(state, cloud, pose, chosen, noise=noise, reach_m=reach_m)
    if only_robot:
        found = found._replace(converged=jnp.asarray(False))
    own = _covariance_of(prior)
    found, decision = _register_jit(state.updates, start, found, own, reach)
    if checked_robot is not None:
        checked_robot = _move_robot_jit(checked_robot, start, found.pose, decision.registered)
    extras, donate = (checked_robot, checked_noise), donate and not traced
    state = run_update(state, fused_cloud, found.pose, extras, decision.flags, donate)
    # `update` may refuse what a young map takes on trust.
    report, converged, covariance = _confirm_jit(found, decision, state.report, state.updates, own)
    found = found._replace(converged=converged, covariance=covariance)
    return state.replace(report=report), found


def predict_pose(pose: Any, before: Any, after: Any) -> jax.Array:
    """Applies the motion between two poses to another one: pose before^-1 after.

    With odometry these are its poses at two frames, and the refined pose of the first. With none, a
    sensor keeps its velocity: `predict_pose(pose, pose_before, pose)`.

    Args:
        pose: (4, 4) T_world_sensor, of the earlier frame.
        before: (4, 4) T_odom_sensor of the same frame.
        after: (4, 4) T_odom_sensor of the later frame.

    Returns:
        (4, 4) float32 T_world_sensor of the later frame. It is a rotation to float32's last digit,
        so that long chains of predictions stay rigid.

    Raises:
        ValueError: A shape is wrong. Outside jit also: a pose is not finite or not rigid.

    Example:
        >>> predicted = hio.predict_pose(found.pose, odometry[i - 1], odometry[i])
    """
    poses = {"pose": pose, "before": before, "after": after}
    if not is_traced(pose, before, after):
        checked = (jax.device_put(check_pose(each, name)) for name, each in poses.items())
        return _predict_pose_jit(*checked)
    for name, each in poses.items():
        if np.shape(each) != (4, 4):
            raise ValueError(f"{name} has shape {np.shape(each)}, expected (4, 4)")
    return _predict_pose(*(jnp.asarray(as_array(name, each)) for name, each in poses.items()))


@plain
def _predict_pose(pose: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
    turn, back = pose[:3, :3], before[:3, :3].T

    def times(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.matmul(a, b, precision="highest")

    way = times(back, after[:3, 3] - before[:3, 3])
    rotation = times(turn, times(back, after[:3, :3]))
    # One step toward the nearest rotation: a transpose is not the inverse of a matrix that has
    # drifted, and extrapolation would more than double the drift each time.
    rotation = times(
        rotation, 1.5 * jnp.eye(3, dtype=jnp.float32) - 0.5 * times(rotation.T, rotation)
    )
    result = jnp.eye(4, dtype=jnp.float32).at[:3, :3].set(rotation)
    return result.at[:3, 3].set(pose[:3, 3] + times(turn, way))


_predict_pose_jit = jax.jit(_predict_pose)


def prior_of_prediction(pose: Any, reach_m: jax.Array | float) -> tuple[Any, Any]:
    """Returns the prior of a predicted pose that is given without one: its mean and covariance."""
    return pose, (_PREDICTED_DEVIATION * reach_m) ** 2 * jnp.eye(6, dtype=jnp.float32)


def is_near(predicted: jax.Array, pose: jax.Array, reach_m: jax.Array | float) -> jax.Array:
    """Returns whether `track` takes a pose (4, 4) that far from the predicted one (4, 4), ()."""
    return jnp.maximum(*distance_and_angle(predicted, pose)) <= _MOST_MOVED * reach_m


@plain
def _move_robot(
    robot: tuple[jax.Array, jax.Array],
    predicted: jax.Array,
    pose: jax.Array,
    registered: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Moves spheres from where they are seen from the predicted pose to where they are."""
    centers, radii = robot
    turn = jnp.matmul(pose[:3, :3], predicted[:3, :3].T, precision="highest")
    offsets = jnp.matmul(centers - predicted[:3, 3], turn.T, precision="highest")
    return jnp.where(registered, pose[:3, 3] + offsets, centers), radii


_move_robot_jit = jax.jit(_move_robot)


def _covariance_of(prior: tuple[Any, Any] | None) -> jax.Array | None:
    return None if prior is None else on_device("prior covariance", prior[1])


class _Decision(NamedTuple):
    """What is decided before the update.

    Attributes:
        registered: The map determined the pose, () bool.
        as_predicted: The cloud is fused although the map did not determine the pose, () bool.
        updates_if_fused: Number of updates after the cloud is fused, () int32.
        flags: Flags of `Flag` that this raises, () uint32.
    """

    registered: jax.Array
    as_predicted: jax.Array
    updates_if_fused: jax.Array
    flags: jax.Array


@plain
def _register(
    updates: jax.Array,
    predicted: jax.Array,
    found: Registration,
    own: jax.Array | None,
    reach_m: jax.Array,
) -> tuple[Registration, _Decision]:
    """Decides whether a cloud is fused, and where."""
    first = updates == 0
    near = is_near(predicted, found.pose, reach_m)
    registered = found.converged & near & ~first
    # A young map may have too few surfaces to register a cloud, and would never get more.
    fused = registered | (updates < CONFIDENT_UPDATES)
    if own is None:
        own = jnp.where(first, 0, unknown_covariance())
    chosen = found._replace(
        pose=jnp.where(registered, found.pose, predicted),
        covariance=jnp.where(registered, found.covariance, own),
    )
    flags = jnp.where(fused, 0, Flag.NOT_REGISTERED).astype(jnp.uint32)
    return chosen, _Decision(registered, fused & ~registered, updates + 1, flags)


_register_jit = jax.jit(_register)


@jax.jit
def _confirm_jit(
    found: Registration,
    decision: _Decision,
    report: Report,
    updates: jax.Array,
    own: jax.Array | None,
) -> tuple[Report, jax.Array, jax.Array]:
    """Returns the report, whether a cloud was registered, and the covariance of its pose."""
    first = decision.updates_if_fused == 1
    as_predicted = decision.as_predicted & (updates == decision.updates_if_fused)
    flag = jnp.where(as_predicted & ~first, Flag.FUSED_AS_PREDICTED, 0).astype(jnp.uint32)
    report = report.replace(update_flags=report.update_flags | flag, flags=report.flags | flag)
    converged = decision.registered | (as_predicted & first)
    other = unknown_covariance() if own is None else own
    return report, converged, jnp.where(converged, found.covariance, other)
