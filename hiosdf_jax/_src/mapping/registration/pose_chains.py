"""Fits a chain of poses to noisy poses and to accurate motions between neighbors, in float64.

Registered motion is accurate from frame to frame, but its errors add up. The given poses are noisy,
but do not drift. Damped Gauss-Newton iterations over all poses find the chain that agrees best with
both.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

_ITERATIONS = 200
_MOST_HALVINGS = 20
_FINISHED = 1e-7  # largest update, m and rad
_UNFINISHED = 1e-4


class Poses(NamedTuple):
    """N poses, or N motions, each in the frame of the sensor before it.

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
        motions: The registered motions between neighboring frames.
        scales: (N - 1, 6); they do the same for the errors of these, or are 0 for unknown motions.
    """

    given: Poses
    weights: np.ndarray
    motions: Poses
    scales: np.ndarray


class Errors(NamedTuple):
    """Errors of the poses and of the motions, of variance 1.

    Attributes:
        of_poses: (N, 6).
        of_motions: (N - 1, 6).
        turned: Rotation vectors of the errors, (N, 3) and (N - 1, 3) rad.
    """

    of_poses: np.ndarray
    of_motions: np.ndarray
    turned: tuple[np.ndarray, np.ndarray]


def fit_chain(
    registered: np.ndarray,
    known: np.ndarray,
    given: np.ndarray,
    weights: np.ndarray,
    motion_deviation: np.ndarray,
) -> np.ndarray:
    """Finds poses near given ones, with the motion of registered ones.

    Warns if the poses have not come to rest.

    Args:
        registered: (N, 4, 4) T_world_sensor, N > 0.
        known: (N,) bool, whether the registered pose of a frame is known.
        given: (N, 4, 4) T_world_sensor.
        weights: As in `Measured`.
        motion_deviation: (6,) of the registered motions, m and rad.

    Returns:
        (N, 4, 4).
    """
    poses = _poses_of(registered)
    both_known = known[:-1] & known[1:]
    measured = Measured(
        given=_poses_of(given),
        weights=weights,
        motions=_motions_of(poses),
        scales=both_known[:, None] / motion_deviation,
    )
    errors, size = _compare(measured, poses), np.inf
    for _ in range(_ITERATIONS):
        updates = _find_updates(measured, poses, errors)
        poses, errors, size = _move(measured, poses, errors, updates)
        if size < _FINISHED:
            break
    if size > _UNFINISHED:
        warnings.warn(
            f"the poses still moved by {size:.1g} m or rad after {_ITERATIONS} iterations; given "
            "and registered poses may contradict each other",
            stacklevel=3,
        )
    result = np.tile(np.eye(4), (len(given), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = poses.turns.as_matrix(), poses.places
    return result


def _poses_of(matrices: np.ndarray) -> Poses:
    return Poses(Rotation.from_matrix(matrices[:, :3, :3]), matrices[:, :3, 3])


def _motions_of(poses: Poses) -> Poses:
    back = poses.turns[:-1].inv()
    return Poses(back * poses.turns[1:], back.apply(np.diff(poses.places, axis=0)))


def _move(
    measured: Measured, poses: Poses, errors: Errors, updates: np.ndarray
) -> tuple[Poses, Errors, float]:
    """Applies updates, halved until the cost does not rise; returns the largest one, too."""
    cost = _cost(errors)
    for _ in range(_MOST_HALVINGS):
        turns = Rotation.from_rotvec(updates[:, 3:]) * poses.turns
        moved = Poses(turns, poses.places + updates[:, :3])
        compared = _compare(measured, moved)
        if _cost(compared) <= cost:
            return moved, compared, float(np.abs(updates).max())
        updates = updates / 2
    return poses, errors, 0.0


def _compare(measured: Measured, poses: Poses) -> Errors:
    turned = (poses.turns * measured.given.turns.inv()).as_rotvec()
    of_poses = np.hstack([poses.places - measured.given.places, turned])
    motions = _motions_of(poses)
    motion_turned = (motions.turns * measured.motions.turns.inv()).as_rotvec()
    of_motions = np.hstack([motions.places - measured.motions.places, motion_turned])
    return Errors(
        np.einsum("nij,nj->ni", measured.weights, of_poses),
        measured.scales * of_motions,
        (turned, motion_turned),
    )


def _cost(errors: Errors) -> float:
    """Pseudo-Huber of the errors of each pose and motion, which have six components."""
    of_all = np.concatenate([errors.of_poses, errors.of_motions])
    return float(np.sum(12 * (np.sqrt(1 + np.mean(of_all**2, axis=1)) - 1)))


def _find_updates(measured: Measured, poses: Poses, errors: Errors) -> np.ndarray:
    """Returns the Gauss-Newton update of all poses, (N, 6): m, and rad about the sensors."""
    count = len(poses.places)
    by_pose = np.tile(np.eye(6), (count, 1, 1))
    by_pose[:, 3:, 3:] = _slope_of_rotvec(errors.turned[0])
    error, (by_pose,) = _robust(errors.of_poses, measured.weights @ by_pose)

    back = poses.turns[:-1].inv().as_matrix()
    by_second = np.zeros((count - 1, 6, 6))
    by_second[:, :3, :3] = back
    by_second[:, 3:, 3:] = _slope_of_rotvec(errors.turned[1]) @ back
    by_first = -by_second
    by_first[:, :3, 3:] = back @ _crossing(np.diff(poses.places, axis=0))
    scales = measured.scales[..., None]
    motion_error, (by_first, by_second) = _robust(
        errors.of_motions, scales * by_first, scales * by_second
    )

    diagonal = _squares(by_pose, by_pose)
    diagonal[:-1] += _squares(by_first, by_first)
    diagonal[1:] += _squares(by_second, by_second)
    beside = _squares(by_first, by_second)
    slope = _products(by_pose, error)
    slope[:-1] += _products(by_first, motion_error)
    slope[1:] += _products(by_second, motion_error)
    return -solveh_banded(_banded(diagonal, beside), slope.ravel()).reshape(count, 6)


def _robust(error: np.ndarray, *slopes: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Weights errors (N, 6) and their slopes so that squares have the derivative of the cost."""
    weight = (1 + np.mean(error**2, axis=1)) ** -0.25  # the root of the weight of the square
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
    """Returns matrices (N, 3, 3) whose products are cross products with vectors (N, 3)."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(-1, -2)


def _slope_of_rotvec(vectors: np.ndarray) -> np.ndarray:
    """Returns derivatives (N, 3, 3) of rotation vectors (N, 3) by a further rotation."""
    angle = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-3)[:, None, None]
    across = _crossing(vectors)
    second = (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.eye(3) - across / 2 + second * across @ across
