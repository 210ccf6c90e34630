"""Tracks a stream by odometry that drifts: finds its scale and its turn while it maps."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.registration.motion import (
    motion_between,
    move,
    rotation_of,
    way_and_angle,
)
from hiosdf_jax._src.mapping.registration.refining import Registration
from hiosdf_jax._src.mapping.tracking import REACH_M, fuse_at, predict_pose, try_pose
from hiosdf_jax._src.numerics.intake import as_array, as_number, check_pose, is_traced
from hiosdf_jax._src.numerics.modes import plain
from hiosdf_jax._src.numerics.small_matrices import solve_positive
from hiosdf_jax._src.state import Flag, MapState

# What is known of any odometry: the standard deviations of its scale and of its turn, rad/m, and
# by how much they change, per square root of a meter.
_SCALE, _SCALE_WALK = 0.02, 1e-4
_TURN, _TURN_WALK = np.radians(0.2), np.radians(0.001)

# Of good odometry between two frames: m, m per m; rad, rad per m, rad per rad.
_MOTION_DEVIATION = (3e-4, 2.5e-3), (5e-5, 2e-4, 2.5e-3)

# Standard deviations of a registered pose along each axis, m and rad: four times those that were
# measured in the demo's apartment, since the map that frames are registered by is not exact either.
_REGISTERED = 0.01, np.radians(0.3)

# Successive frames see the same patches and share their errors: so many of them count as one.
_SHARED = 4.0

# A frame is not fused if its corrected pose differs so much from the registered one that chance
# would do it in 1 of 1,000 (chi-square, 6 components). If this goes on for about so many frames,
# the odometry failed, as where wheels slip, and registration is believed.
_MOST_SURPRISE = 22.5
_REFUSALS = 20


class Odometry(NamedTuple):
    """Odometry, and what the map has shown of its errors.

    Attributes:
        pose: (4, 4) T_world_sensor of the last frame.
        given: (4, 4) T_odom_sensor of the same frame.
        scale: What is missing of the length of motions, () float32: 0.01 if they are 1 % too short.
        turn: The rotation that is missing after 1 m, (3,) float32, rad/m, along the sensor's axes.
        covariance: Of the errors of the pose (as in `Registration`), scale and turn, (10, 10).
        deviation: The five numbers of `motion_deviation`, see `start_odometry`, (5,) float32.
    """

    pose: jax.Array
    given: jax.Array
    scale: jax.Array
    turn: jax.Array
    covariance: jax.Array
    deviation: jax.Array


def start_odometry(
    pose: Any,
    given_pose: Any,
    motion_deviation: tuple[tuple[float, float], tuple[float, float, float]] = _MOTION_DEVIATION,
) -> Odometry:
    """Begins to track by odometry.

    Args:
        pose: (4, 4) T_world_sensor of the first frame.
        given_pose: (4, 4) T_odom_sensor of the same frame, as odometry has it.
        motion_deviation: ((m, m per m), (rad, rad per m, rad per rad)): standard deviations of the
            motion between two frames along each axis: at rest, per meter of way, and of rotations
            per radian turned. Only of its noise: a wrong scale and a steady turn are estimated.
            The default is that of good wheels or visual-inertial odometry.

    Returns:
        The odometry, for `track_odometry`.

    Raises:
        ValueError: A shape is wrong, a pose is not finite or not rigid, or a deviation is negative.

    Example:
        >>> odometry = hio.start_odometry(np.eye(4), wheel_poses[0])
    """
    poses = [jax.device_put(check_pose(pose)), jax.device_put(check_pose(given_pose, "given_pose"))]
    try:
        (rest_m, per_way), (rest_rad, turn_per_way, per_turn) = motion_deviation
    except (TypeError, ValueError):
        expected = "((m, m per m), (rad, rad per m, rad per rad))"
        raise ValueError(f"motion_deviation is {motion_deviation}, expected {expected}") from None
    deviation = [
        as_number("motion_deviation", each, 0.0)
        for each in (rest_m, per_way, rest_rad, turn_per_way, per_turn)
    ]
    variance = np.diag([0.0] * 6 + [_SCALE**2] + [_TURN**2] * 3)
    zeros = np.zeros(4, np.float32)
    return Odometry(
        *poses,
        *jax.device_put((zeros[0], zeros[1:])),
        *jax.device_put((variance.astype(np.float32), np.array(deviation, np.float32))),
    )


def track_odometry(
    state: MapState,
    cloud: Any,
    odometry: Odometry,
    given_pose: Any,
    *,
    donate: bool = False,
    noise: tuple[Any, Any] | None = None,
    reach_m: Any = REACH_M,
) -> tuple[MapState, Odometry, Registration]:
    """Tracks a cloud by odometry whose noise is known, and fuses it.

    `track` follows every registration, and their small errors add up. Here odometry predicts the
    motion between frames, and a Kalman filter corrects the pose, the scale of odometry and its turn
    per meter by what registration finds. So a map drifts less, if odometry is smoother than
    registration. A frame whose registration contradicts it is not fused. Where this goes on for
    some 20 frames, as after wheels have slipped, the registration is believed. Pure: works inside
    `jit`, `vmap` and `lax.scan`.

    Args:
        state: The map so far.
        cloud: (N, 3) m, sensor frame; rows with a NaN or inf are no returns and are ignored.
        odometry: From `start_odometry`, or from the last frame.
        given_pose: (4, 4) T_odom_sensor of this frame, as odometry has it.
        donate: As for `update`; of the map only.
        noise: As for `update`.
        reach_m: As for `track`.

    Returns:
        The new map, the odometry with its corrected `pose`, and the registration, as from `track`,
        with that pose and its covariance. The first cloud is fused at the pose that
        `start_odometry` was given.

    Raises:
        ValueError: As `track` does, or `odometry` is no Odometry.

    Example:
        >>> odometry = hio.start_odometry(np.eye(4), wheel_poses[0])
        >>> for cloud, wheel_pose in zip(clouds, wheel_poses):
        ...     state, odometry, found = hio.track_odometry(state, cloud, odometry, wheel_pose)
    """
    if not isinstance(odometry, Odometry):
        raise ValueError(f"odometry is {type(odometry).__name__}, expected a hio.Odometry")
    if is_traced(given_pose):
        if np.shape(given_pose) != (4, 4):
            raise ValueError(f"given_pose has shape {np.shape(given_pose)}, expected (4, 4)")
        given = jnp.asarray(as_array("given_pose", given_pose), jnp.float32)
    else:
        given = jax.device_put(check_pose(given_pose, "given_pose"))
    predicted = _predict_jit(odometry, given)
    tried = try_pose(state, cloud, predicted.pose, None, noise, reach_m)
    corrected, found, flags = _correct_jit(predicted, tried.found, tried.registered, tried.flags)
    return fuse_at(tried._replace(flags=flags), corrected.pose, donate), corrected, found


@plain
def _predict(odometry: Odometry, given: jax.Array) -> Odometry:
    """Adds the motion of odometry, without the errors that are known."""
    identity = jnp.eye(4, dtype=jnp.float32)
    motion = predict_pose(identity, odometry.given, given)
    way = motion[:3, 3]
    length = jnp.linalg.norm(way)
    turn = _times(motion[:3, :3], rotation_of(length * odometry.turn))
    motion = motion.at[:3, :3].set(turn).at[:3, 3].multiply(1 + odometry.scale)
    pose = predict_pose(odometry.pose, identity, motion)

    # The errors of the earlier pose, scale and turn, carried to this one.
    way_world = _times(odometry.pose[:3, :3], way)
    carried = jnp.eye(10, dtype=jnp.float32)
    leap = jnp.cross(jnp.eye(3, dtype=jnp.float32), (1 + odometry.scale) * way_world).T
    carried = carried.at[:3, 3:6].set(leap)
    carried = carried.at[:3, 6].set(way_world).at[3:6, 7:].set(length * pose[:3, :3])
    rest_m, per_way, rest_rad, turn_per_way, per_turn = odometry.deviation
    _, angle = way_and_angle(identity, motion)
    deviation = jnp.concatenate(
        [
            jnp.full(3, rest_m + per_way * length),
            jnp.full(3, rest_rad + turn_per_way * length + per_turn * angle),
            jnp.sqrt(length) * jnp.array([_SCALE_WALK] + 3 * [_TURN_WALK], jnp.float32),
        ]
    )
    covariance = _times(carried, _times(odometry.covariance, carried.T))
    covariance += jnp.diag(deviation**2)
    return odometry._replace(pose=pose, given=given, covariance=covariance)


@plain
def _correct(
    odometry: Odometry, found: Registration, registered: jax.Array, flags: jax.Array
) -> tuple[Odometry, Registration, jax.Array]:
    """Corrects the prediction by a registered pose, as a Kalman filter does, or refuses that."""
    surprise = motion_between(odometry.pose, found.pose)
    before = odometry.covariance
    seen = jnp.where(registered, found.covariance, 0)
    own = jnp.diag(jnp.repeat(jnp.array(_REGISTERED, jnp.float32) ** 2, 3))
    uncertain = _SHARED * own + seen
    size, scaled = _scaled(before[:6, :6] + uncertain)
    gain = jax.vmap(lambda row: size * solve_positive(scaled, size * row))(before[:, :6])
    correction = _times(gain, surprise)
    # Joseph's form stays symmetric and positive.
    rest = jnp.eye(10, dtype=jnp.float32).at[:, :6].add(-gain)
    after = _times(rest, _times(before, rest.T))
    after += _times(gain, _times(uncertain, gain.T))
    corrected = odometry._replace(
        pose=move(odometry.pose, correction[:6]),
        scale=odometry.scale + correction[6],
        turn=odometry.turn + correction[7:],
        covariance=after,
    )
    left = surprise - correction[:6]
    size, scaled = _scaled(own + seen)
    likely = left @ (size * solve_positive(scaled, size * left)) < _MOST_SURPRISE
    widened = before.at[:6, :6].add(jnp.outer(surprise, surprise) / _REFUSALS**2)
    refused = odometry._replace(covariance=widened)

    def choose(some: jax.Array, other: jax.Array, kept: jax.Array) -> jax.Array:
        return jnp.where(registered, jnp.where(likely, some, other), kept)

    result = jax.tree.map(choose, corrected, refused, odometry)
    fused = found.converged & (likely | ~registered)
    covariance = jnp.where(registered, result.covariance[:6, :6], found.covariance)
    found = found._replace(pose=result.pose, covariance=covariance, converged=fused)
    return result, found, flags | jnp.where(fused, 0, Flag.NOT_REGISTERED).astype(jnp.uint32)


def _scaled(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """One over its deviations, and it in their units: those of free directions are much larger."""
    size = jax.lax.rsqrt(jnp.diag(covariance))
    return size, size[:, None] * covariance * size


_predict_jit = jax.jit(_predict)
_correct_jit = jax.jit(_correct)


def _times(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision="highest")
