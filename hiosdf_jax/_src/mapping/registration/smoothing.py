"""Poses of a whole stream that keep its registered motion and stay near its given poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from hiosdf_jax._src.numerics.intake import (
    as_number,
    as_real,
    check_covariance,
    check_pose,
    is_traced,
)

# A given pose counts at least as if its standard deviation were this, m and rad: with less, the
# normal equations are singular to rounding.
_MOST_DEVIATION = 1000.0

# Eigenvalues of a correlation matrix below this are rounding errors of float32.
_LEAST_EIGENVALUE = 1e-7


def smooth_poses(
    poses: Any,
    given_poses: Any,
    covariance: Any,
    registered: Any | None = None,
    motion_deviation: tuple[float, float] = (0.002, 0.0005),
) -> np.ndarray:
    """Corrects the drift of registered poses by given ones, which are noisy but do not drift.

    `track` trades the noise of given poses for drift. This finds the trajectory that keeps the
    registered motion from frame to frame and stays near the given poses. Map the stream again at
    the poses that it returns.

    With r_i the error of a pose against the given one, and m_i the error of its motion from the
    pose before against the registered motion, both in standard deviations, it minimizes the sum of
    12 (sqrt(1 + |e|^2 / 6) - 1) over all e of r_i and m_i: pseudo-Huber, so that single wild poses
    bend nothing. All errors are assumed to be independent of each other. Runs on the host, not
    inside `jit`.

    Args:
        poses: (N, 4, 4) T_world_sensor, registered, in the order of the stream.
        given_poses: (N, 4, 4) T_world_sensor, of the same frames.
        covariance: (6, 6) of the error of each given pose, as in `Registration`: m along the axes
            of the world frame, and rad about the sensor. Or (N, 6, 6), one for each pose. Give an
            unknown rotation a standard deviation of 10 rad.
        registered: (N,) bool, whether each frame was registered; by default all were. The motion
            to and from one that was not does not count. It takes its given pose, even if that is
            wild: do not fuse such frames.
        motion_deviation: Standard deviations of the registered motion between two frames, along
            each axis, m and rad. The default is measured on a depth camera whose frames are up to
            1 m apart.

    Returns:
        (N, 4, 4) float32 T_world_sensor.

    Raises:
        ValueError: A shape is wrong, a pose is not finite or not rigid, or a covariance is not
            symmetric and positive definite.

    Example:
        >>> covariance = np.diag([0.01**2] * 3 + [0.01**2] * 3)  # m, rad
        >>> poses = hio.smooth_poses(tracked, given, covariance, registered)
        >>> for cloud, pose in zip(clouds[registered], poses[registered]):
        ...     state = hio.update(state, cloud, pose)
    """
    # Imported here, so that the core needs no scipy.
    from hiosdf_jax._src.mapping.registration.pose_chains import fit_chain

    start = _check_poses("poses", poses)
    given = _check_poses("given_poses", given_poses, len(start))
    weights = _weights_of(covariance, len(given))
    known = _check_registered(registered, len(given))
    if as_real("motion_deviation", motion_deviation).shape != (2,):
        raise ValueError(f"motion_deviation is {motion_deviation!r}, expected (m, rad)")
    deviation = [as_number("motion_deviation", each, 0, above=True) for each in motion_deviation]
    if len(given) == 0:
        return np.zeros((0, 4, 4), np.float32)
    try:
        result = fit_chain(start, known, given, weights, np.repeat(deviation, 3))
    except ValueError as error:  # also numpy's LinAlgError
        raise ValueError(
            f"motion_deviation is {motion_deviation!r}, expected larger ones for this covariance: "
            "the normal equations are singular"
        ) from error
    return result.astype(np.float32)


def _check_poses(name: str, poses: Any, count: int | None = None) -> np.ndarray:
    array = as_real(name, poses).astype(np.float64)
    if array.size == 0 and count in (None, 0):
        return np.zeros((0, 4, 4))
    expected = "(N, 4, 4)" if count is None else f"({count}, 4, 4)"
    if array.ndim != 3 or array.shape[1:] != (4, 4) or count not in (None, len(array)):
        raise ValueError(f"{name} has shape {array.shape}, expected {expected}")
    for i, pose in enumerate(array):
        check_pose(pose, f"{name}[{i}]")
    return array


def _check_registered(registered: Any | None, count: int) -> np.ndarray:
    if registered is None or count == 0:
        return np.ones(count, bool)
    if is_traced(registered):
        raise ValueError("registered is traced, expected concrete values, as outside jit")
    try:
        mask = np.ma.filled(np.ma.asanyarray(registered), False)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"registered is not an array: {error}") from error
    if mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(f"registered is {mask.dtype} {mask.shape}, expected bool ({count},)")
    return mask


def _weights_of(covariance: Any, count: int) -> np.ndarray:
    """Returns matrices (N, 6, 6) that turn an error into independent ones of variance 1."""
    array = as_real("covariance", covariance).astype(np.float64)
    if array.shape == (6, 6):
        check_covariance("covariance", array)
    elif array.shape == (count, 6, 6):
        for i, each in enumerate(array):
            check_covariance(f"covariance[{i}]", each)
    else:
        raise ValueError(f"covariance has shape {array.shape}, expected (6, 6) or ({count}, 6, 6)")
    size = np.sqrt(np.diagonal(array, axis1=-2, axis2=-1))
    scaled = array / (size[..., :, None] * size[..., None, :])
    values, vectors = np.linalg.eigh((scaled + np.swapaxes(scaled, -1, -2)) / 2)
    roots = np.swapaxes(vectors, -1, -2) / size[..., None, :]
    roots /= np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))[..., None]
    information = np.swapaxes(roots, -1, -2) @ roots + np.eye(6) / _MOST_DEVIATION**2
    root = np.linalg.cholesky(information)
    return np.broadcast_to(np.swapaxes(root, -1, -2), (count, 6, 6))
