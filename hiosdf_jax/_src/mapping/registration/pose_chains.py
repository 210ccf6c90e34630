"""Fits a chain of poses to noisy poses and to exact motions between neighbors, in float64.

Registration is exact from frame to frame, but its errors add up. Given poses that are noisy do not
drift. Gauss-Newton steps over all poses find the chain that agrees best with both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

# Standard deviations of the registered motion from one frame to the next, along each axis, m and
# rad. On house_depth, whose frames are up to 1 m apart, its errors are about twice as large while
# it is tracked, and less than that once the stream is mapped again.
MOTION = 0.002, 0.0005

# The same where one of the two frames is not registered: its motion says nothing.
_UNKNOWN_MOTION = 100.0, 100.0

_STEPS = 50
_FINISHED = 1e-8  # largest step, m and rad


class Poses(NamedTuple):
    """Poses of N frames, or N steps, each in the frame of the sensor before it.

    Attributes:
        turns: N rotations.
        places: (N, 3) m.
    """

    turns: Rotation
    places: np.ndarray


class Measured(NamedTuple):
    """What the poses should agree with.

    Attributes:
        given: The given poses.
        weights: (N, 6, 6); they turn the errors of given poses into independent ones of variance 1.
        steps: The registered motions between neighboring frames.
        deviations: (N - 1, 6) of the errors of these, m and rad.
    """

    given: Poses
    weights: np.ndarray
    steps: Poses
    deviations: np.ndarray


def fit_chain(
    registered: np.ndarray, known: np.ndarray, given: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Finds poses near given ones, with the motion of registered ones.

    Args:
        registered: (N, 4, 4) T_world_sensor.
        known: (N,) bool, whether the registered pose of a frame is known.
        given: (N, 4, 4) T_world_sensor.
        weights: As in `Measured`.

    Returns:
        (N, 4, 4).
    """
    poses = _poses_of(registered)
    measured = Measured(
        given=_poses_of(given),
        weights=weights,
        steps=_steps_of(poses),
        deviations=np.where(
            (known[:-1] & known[1:])[:, None], np.repeat(MOTION, 3), np.repeat(_UNKNOWN_MOTION, 3)
        ),
    )
    for _ in range(_STEPS if len(given) else 0):
        motions = _find_motions(measured, poses)
        turns = Rotation.from_rotvec(motions[:, 3:]) * poses.turns
        poses = Poses(turns, poses.places + motions[:, :3])
        if np.abs(motions).max() < _FINISHED:
            break
    result = np.tile(np.eye(4), (len(given), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = poses.turns.as_matrix(), poses.places
    return result


def _poses_of(matrices: np.ndarray) -> Poses:
    return Poses(Rotation.from_matrix(matrices[:, :3, :3]), matrices[:, :3, 3])


def _steps_of(poses: Poses) -> Poses:
    back = poses.turns[:-1].inv()
    return Poses(back * poses.turns[1:], back.apply(np.diff(poses.places, axis=0)))


def _find_motions(measured: Measured, poses: Poses) -> np.ndarray:
    """One Gauss-Newton step for all poses, (N, 6): m, and rad about the sensors."""
    count = len(poses.places)
    turned = (poses.turns * measured.given.turns.inv()).as_rotvec()
    error = np.hstack([poses.places - measured.given.places, turned])
    by_pose = np.tile(np.eye(6), (count, 1, 1))
    by_pose[:, 3:, 3:] = _slope_of_rotvec(turned)
    error, (by_pose,) = _robust(
        np.einsum("nij,nj->ni", measured.weights, error), measured.weights @ by_pose
    )

    steps = _steps_of(poses)
    turned = (steps.turns * measured.steps.turns.inv()).as_rotvec()
    step_error = np.hstack([steps.places - measured.steps.places, turned])
    back = poses.turns[:-1].inv().as_matrix()
    by_second = np.zeros((count - 1, 6, 6))
    by_second[:, :3, :3] = back
    by_second[:, 3:, 3:] = _slope_of_rotvec(turned) @ back
    by_first = -by_second
    by_first[:, :3, 3:] = back @ _crossing(np.diff(poses.places, axis=0))
    scale = 1 / measured.deviations
    step_error, (by_first, by_second) = _robust(
        scale * step_error, scale[..., None] * by_first, scale[..., None] * by_second
    )

    diagonal = _squares(by_pose, by_pose)
    diagonal[:-1] += _squares(by_first, by_first)
    diagonal[1:] += _squares(by_second, by_second)
    beside = _squares(by_first, by_second)
    slope = _products(by_pose, error)
    slope[:-1] += _products(by_first, step_error)
    slope[1:] += _products(by_second, step_error)
    return -solveh_banded(_banded(diagonal, beside), slope.ravel()).reshape(count, 6)


def _robust(error: np.ndarray, *slopes: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Weights the rows of errors (N, 6) of variance 1, and of their slopes, by pseudo-Huber."""
    weight = (1 + np.mean(error**2, axis=1)) ** -0.25  # the root of the weight of its square
    return weight[:, None] * error, [weight[:, None, None] * slope for slope in slopes]


def _squares(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("nki,nkj->nij", first, second)


def _products(slope: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.einsum("nki,nk->ni", slope, error)


def _banded(diagonal: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Stores blocks (N, 6, 6), and those right of them (N - 1, 6, 6), as `solveh_banded` reads."""
    count = len(diagonal)
    upper = np.zeros((count, 6, 12))
    upper[:, :, :6] = np.triu(diagonal)
    upper[:-1, :, 6:] = beside
    banded = np.zeros((12, 6 * count))
    for row in range(6):
        for above in range(12 - row):
            columns = np.arange(row + above, 6 * count, 6)
            banded[11 - above, columns] = upper[: len(columns), row, row + above]
    return banded


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) that multiply by vectors (N, 3) from the left, as a cross product."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(-1, -2)


def _slope_of_rotvec(vectors: np.ndarray) -> np.ndarray:
    """Derivatives (N, 3, 3) of rotation vectors (N, 3) by a further rotation."""
    angle = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-3)[:, None, None]
    across = _crossing(vectors)
    second = (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.eye(3) - across / 2 + second * across @ across
