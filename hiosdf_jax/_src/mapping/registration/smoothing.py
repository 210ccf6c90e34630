"""Poses of a whole stream that keep its registered motion and stay near its given poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from hiosdf_jax._src.numerics.intake import as_real, check_covariance, check_pose


def smooth_poses(
    poses: Any, given_poses: Any, covariance: Any, registered: Any | None = None
) -> np.ndarray:
    """Corrects the drift of registered poses by given ones, which are noisy but do not drift.

    A robot that is localized by GPS, by beacons or in a floor plan has such poses. `track` removes
    their noise, but its own errors add up. Map the stream again at the poses that this returns.

    It minimizes the sum of squares of two kinds of errors, robustly (pseudo-Huber): of each pose
    against the given one, and of the motion between neighboring frames against that of the
    registered poses. Runs on the host, not inside `jit`.

    Args:
        poses: (N, 4, 4) T_world_sensor, registered, in the order of the stream.
        given_poses: (N, 4, 4) T_world_sensor, of the same frames.
        covariance: (6, 6) of the error of each given pose, as in `Registration`: m along the axes
            of the world frame, and rad about the sensor. Or (N, 6, 6), one for each pose.
        registered: (N,) bool, whether each frame was registered; by default all were. The pose of
            one that was not is a guess, and the motion to and from it counts for nothing.

    Returns:
        (N, 4, 4) float32 T_world_sensor.

    Raises:
        ValueError: A shape is wrong, a pose is not finite or not rigid, or a covariance is not
            symmetric and positive definite.

    Example:
        >>> covariance = np.diag([0.01**2] * 3 + [0.01**2] * 3)  # m, rad
        >>> poses = hio.smooth_poses(tracked, given, covariance)
        >>> for cloud, pose in zip(clouds, poses):
        ...     state = hio.update(state, cloud, pose)
    """
    # Imported here, so that the core needs no scipy.
    from hiosdf_jax._src.mapping.registration.pose_chains import fit_chain

    registered_poses = _check_poses("poses", poses)
    given = _check_poses("given_poses", given_poses, len(registered_poses))
    weights = _weights_of(covariance, len(given))
    known = _check_registered(registered, len(given))
    return fit_chain(registered_poses, known, given, weights).astype(np.float32)


def _check_poses(name: str, poses: Any, count: int | None = None) -> np.ndarray:
    array = as_real(name, poses).astype(np.float64)
    expected = "(N, 4, 4)" if count is None else f"({count}, 4, 4)"
    if array.ndim != 3 or array.shape[1:] != (4, 4) or count not in (None, len(array)):
        raise ValueError(f"{name} has shape {array.shape}, expected {expected}")
    for i, pose in enumerate(array):
        check_pose(pose, f"{name}[{i}]")
    return array


def _check_registered(registered: Any | None, count: int) -> np.ndarray:
    mask = np.ones(count, bool) if registered is None else np.asarray(registered)
    if mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(f"registered is {mask.dtype} {mask.shape}, expected bool ({count},)")
    return mask


def _weights_of(covariance: Any, count: int) -> np.ndarray:
    """Returns matrices (N, 6, 6) that turn an error into independent ones of variance 1."""
    array = as_real("covariance", covariance).astype(np.float64)
    if array.shape not in ((6, 6), (count, 6, 6)):
        raise ValueError(f"covariance has shape {array.shape}, expected (6, 6) or ({count}, 6, 6)")
    for each in array.reshape(-1, 6, 6):
        check_covariance("covariance", each)
    return np.linalg.inv(np.linalg.cholesky(np.broadcast_to(array, (count, 6, 6))))
