"""Registers the frames of a stream one after another, and writes the trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.registration.comparing import GROWING_REACH_M
from hiosdf_jax._src.mapping.registration.refining import Registration, refine_pose
from hiosdf_jax._src.mapping.tracking import (
    is_near,
    predict_pose,
    prior_of_prediction,
    track,
)
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state.pytrees import MapState
from hiosdf_jax._src.view.paths import save_paths

TRAJECTORY = ("trajectory.txt", "trajectory.npz", "trajectory.png")

_LEAST_DISTANCE_M = 0.05  # shorter distances drift as this one does
_MOST_AHEAD = 5  # times the last motion; farther ahead the prediction is worse than none
_LOST_FRAMES = 5  # a stream is lost if this many frames at its end do not fit


class Tracked(NamedTuple):
    """A frame and its pose.

    Attributes:
        frame: Its index in the stream.
        given: (4, 4) T_world_sensor, as the stream has it.
        pose: (4, 4) T_world_sensor, as the map has it; predicted, if the frame is not registered.
        covariance: (6, 6) of the pose's error, m and rad, see `Registration`.
        registered: Whether the map determined the pose. That of the first frame defines the map.
        fused: Whether `pose` may serve to predict others: it is registered, or the map was young
            and fused the frame where it was predicted.
    """

    frame: int
    given: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    registered: bool
    fused: bool


class Tracker:
    """Predicts and registers the poses of a stream.

    The first frame has the pose that the stream gives it. Later ones are predicted from the last
    registered frame by the motion between the stream's poses, or, for odometry, from the last two
    frames by keeping the velocity, also over frames that are missing.

    Attributes:
        frames: The frames so far, a `Tracked` each.
    """

    def __init__(
        self,
        odometry: bool,
        drift: Sequence[float] | None = None,
        stamps: np.ndarray | None = None,
    ) -> None:
        """Begins before the first frame.

        Args:
            odometry: Use no pose of the stream but the first.
            drift: Standard deviations of the motion: share of the distance, and degrees per
                meter. Then predicted poses are priors. By default they are as exact as `track`
                assumes.
            stamps: (F,) s, times of the stream's frames. Where they are not known, or do not
                increase, the indices of the frames take their place.
        """
        self.frames: list[Tracked] = []
        self._odometry = odometry
        self._drift = drift
        self._stamps = stamps
        self._fitting: list[Tracked] = []  # the last two frames that fit

    def predict(self, given: np.ndarray, frame: int) -> np.ndarray:
        """Predicts the pose of the next frame.

        Args:
            given: (4, 4) T_world_sensor, as the stream has it.
            frame: Its index in the stream.

        Returns:
            (4, 4) T_world_sensor.
        """
        if not self._fitting:
            return given
        last = self._fitting[-1]
        if not self._odometry:
            return np.asarray(predict_pose(last.pose, last.given, given))
        if len(self._fitting) < 2:
            return last.pose
        before = self._fitting[0]
        times = self._times(before.frame, last.frame, frame)
        ahead = min((times[2] - times[1]) / (times[1] - times[0]), _MOST_AHEAD)
        return continued(before.pose, last.pose, ahead)

    def prior_of(self, predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the prior of a predicted pose (4, 4), or None where the drift is not known."""
        if self._drift is None or not self._fitting:
            return None
        share, degrees = self._drift
        moved_m = float(np.linalg.norm(predicted[:3, 3] - self._fitting[-1].pose[:3, 3]))
        deviation = max(moved_m, _LEAST_DISTANCE_M) * np.repeat([share, np.radians(degrees)], 3)
        return predicted, np.diag(deviation**2)

    def fuse(
        self, state: MapState, cloud: np.ndarray, given: np.ndarray, frame: int
    ) -> tuple[MapState, np.ndarray]:
        """Registers a frame and fuses it if it fits; returns the map and the pose (4, 4)."""
        predicted = self.predict(given, frame)
        updates = int(state.updates)
        state, found = track(state, cloud, predicted, self.prior_of(predicted))
        return state, self._add(frame, given, found, int(state.updates) > updates)

    def locate(
        self, state: MapState, cloud: np.ndarray, given: np.ndarray, frame: int
    ) -> np.ndarray:
        """Registers a frame that the map is not given; returns the pose (4, 4)."""
        predicted = self.predict(given, frame)
        prior = self.prior_of(predicted) or prior_of_prediction(predicted, GROWING_REACH_M)
        found = refine_pose(state, cloud, predicted, prior, reach_m=GROWING_REACH_M)
        fits = bool(found.converged & is_near(jnp.asarray(predicted), found.pose, GROWING_REACH_M))
        if not fits:
            found = found._replace(
                pose=predicted, covariance=prior[1], converged=jnp.asarray(False)
            )
        return self._add(frame, given, found, fits)

    def counts(self) -> dict[str, int | None]:
        """How the frames fit the map, by the keys of `metrics.json`.

        `lost_since` is the first of at least five frames at the end of the stream that did not fit,
        or None.
        """
        registered = sum(each.registered for each in self.frames)
        fused = sum(each.fused for each in self.frames)
        fitting = [k for k, each in enumerate(self.frames) if each.fused]
        missed = self.frames[fitting[-1] + 1 if fitting else 0 :]
        return {
            "frames_registered": registered,
            "frames_as_predicted": fused - registered,
            "frames_not_registered": len(self.frames) - fused,
            "lost_since": missed[0].frame if len(missed) >= _LOST_FRAMES else None,
        }

    def write(self, folder: Path, up_world: np.ndarray) -> None:
        """Writes `trajectory.txt`, `trajectory.npz` and `trajectory.png`.

        The times are those of the stream, or else the indices of the frames.

        Args:
            folder: Where to write.
            up_world: (3,) unit vector against gravity; the picture looks down along it.
        """
        from scipy.spatial.transform import Rotation

        given, poses, covariances = (
            np.stack([np.asarray(getattr(each, name)) for each in self.frames])
            for name in ("given", "pose", "covariance")
        )
        frame = np.array([each.frame for each in self.frames])
        registered = np.array([each.registered for each in self.frames])
        quaternions = without_flips(Rotation.from_matrix(poses[:, :3, :3]).as_quat())
        time = self._times(*frame)
        rows = np.column_stack([time, poses[:, :3, 3], quaternions])
        # Readers of this file tell numbers of frames from times by the first word.
        name, digits = ("frame", "%d") if np.array_equal(time, frame) else ("time", "%.9f")
        with replacing(folder / TRAJECTORY[0]) as file:
            np.savetxt(file, rows, [digits] + 7 * ["%.9g"], header=f"{name} tx ty tz qx qy qz qw")
        with replacing(folder / TRAJECTORY[1]) as file:
            np.savez(
                file,
                frame=frame,
                time=time,
                poses=poses,
                covariance=covariances,
                registered=registered,
            )
        moved = (given != given[0]).any()  # poses that are not known are all the identity
        save_paths(
            folder / TRAJECTORY[2],
            given[:, :3, 3] if moved else None,
            poses[:, :3, 3],
            registered,
            100 * np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2)),
            up_world,
        )

    def _times(self, *frames: int) -> np.ndarray:
        """Times of frames, (F,) s, or their indices where not all of the times are usable."""
        indices = np.array(frames, float)
        if self._stamps is None:
            return indices
        times = self._stamps[list(frames)]
        usable = np.isfinite(times).all() and (np.diff(times) > 0).all()
        return times if usable else indices

    def _add(self, frame: int, given: np.ndarray, found: Registration, fused: bool) -> np.ndarray:
        pose, covariance = np.asarray(found.pose), np.asarray(found.covariance)
        tracked = Tracked(frame, given, pose, covariance, bool(found.converged), fused)
        self.frames.append(tracked)
        if fused:
            self._fitting = [*self._fitting[-1:], tracked]
        return tracked.pose


def continued(before: np.ndarray, last: np.ndarray, ahead: float) -> np.ndarray:
    """Continues the motion between two poses.

    Args:
        before: (4, 4) T_world_sensor.
        last: (4, 4) T_world_sensor, later.
        ahead: How long to continue, as a multiple of the time between them.

    Returns:
        (4, 4) float32 T_world_sensor.
    """
    from scipy.spatial.transform import Rotation

    back = before[:3, :3].T
    turn = Rotation.from_matrix(back @ last[:3, :3]).as_rotvec()
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(ahead * turn).as_matrix()
    # The chord of an arc is turned from the arc's beginning by half the angle of the arc.
    chord = Rotation.from_rotvec((ahead - 1) / 2 * turn).apply(back @ (last[:3, 3] - before[:3, 3]))
    motion[:3, 3] = ahead * chord
    return np.asarray(predict_pose(last, np.eye(4), motion))


def without_flips(quaternions: np.ndarray) -> np.ndarray:
    """Of the two quaternions of each rotation, takes the one nearer to that of the frame before.

    Args:
        quaternions: (F, 4).

    Returns:
        (F, 4).
    """
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = 1 - 2 * (np.cumsum(flips) % 2)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[:, None]])
