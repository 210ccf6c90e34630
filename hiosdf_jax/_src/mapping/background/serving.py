"""Fuses one frame after the other into a map and serves what controllers read."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from hiosdf_jax._src.mapping.pipeline import update
from hiosdf_jax._src.numerics.arrays import scalar
from hiosdf_jax._src.numerics.intake import as_floats
from hiosdf_jax._src.numerics.robot_and_noise import check_extras
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import Baked, Field, MapState, field_of

type Serve = Callable[[Field], Field | Baked] | None
"""Turns each snapshot into the field that controllers read; None for the snapshot itself."""

# What `update` raises for a bad frame: the others are faults of the machine or of this library.
# Warnings are raised where the user has made them errors.
_BAD_FRAME = (ValueError, TypeError, OverflowError, Warning)


class Frame(NamedTuple):
    """A posed cloud and what belongs to it, as `update` takes them."""

    cloud: Any
    pose: Any
    stamp: float
    robot: tuple[Any, Any] | None = None
    noise: tuple[Any, Any] | None = None


class Published(NamedTuple):
    """What controllers read; replaced as a whole, so that no reader sees parts of two."""

    field: Any
    stamp: float


class RefusedError(Exception):
    """A frame left the published field as it was.

    Attributes:
        reason: Why.
    """

    def __init__(self, reason: Exception) -> None:
        """Keeps the reason."""
        super().__init__(str(reason))
        self.reason = reason


class Fuser:
    """A map, updated in place.

    Attributes:
        state: The map.
        fault: Why nothing more can be fused; None.
    """

    fault: RuntimeError | None = None

    def __init__(self, state: MapState) -> None:
        """Begins with a map."""
        self.state = state

    def fuse(self, frame: Frame, serve: Serve) -> Published:
        """Fuses a frame.

        Args:
            frame: The frame, from `checked`.
            serve: Function applied to the snapshot.

        Returns:
            The new field and its stamp. All of it is computed: no reader waits for the device.

        Raises:
            RefusedError: The frame or its field is bad.
            Exception: Anything else that `update` raises.
        """
        try:
            # The old state is not donated, so that the old field stays valid without a copy.
            state = jax.block_until_ready(
                update(self.state, frame.cloud, frame.pose, robot=frame.robot, noise=frame.noise)
            )
        except _BAD_FRAME as reason:
            raise RefusedError(reason) from reason
        fused = int(state.updates) > int(self.state.updates)
        self.state = state
        if not fused:
            flags = Flag(int(state.report.update_flags))
            reason = ValueError(f"update refused the frame and raised the flags {flags}")
            raise RefusedError(reason) from reason
        try:
            return publish(state, serve, frame.stamp)
        except Exception as reason:  # whatever a function of the user's raises
            raise RefusedError(reason) from reason

    def fetch(self) -> MapState:
        """Returns the map."""
        return self.state

    def stop(self) -> None:
        """Ends what runs elsewhere: nothing here."""


def publish(state: MapState, serve: Serve, stamp: float = -math.inf) -> Published:
    """Computes what controllers read from a map.

    Args:
        state: The map.
        serve: Function applied to its snapshot.
        stamp: Time of its newest frame, s; -inf before the first one.

    Returns:
        The computed field, and the stamp.
    """
    field = field_of(state)
    if math.isfinite(stamp):
        field = field.replace(stamp=scalar(stamp))
    return Published(field if serve is None else jax.block_until_ready(serve(field)), stamp)


def checked(frame: Frame) -> Frame:
    """Converts a frame to arrays; raises RefusedError if it has something else."""
    try:
        cloud, pose = as_floats("cloud", frame.cloud), as_floats("pose", frame.pose)
        return Frame(cloud, pose, frame.stamp, *check_extras(frame.robot, frame.noise))
    except Exception as reason:  # whatever an object of the user's raises
        raise RefusedError(reason) from reason
