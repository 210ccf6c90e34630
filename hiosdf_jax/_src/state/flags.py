"""The problems that an update reports."""

from __future__ import annotations

import enum
import operator
from typing import Any

import jax
import numpy as np


class _TakesArrays(enum.EnumType):
    """Lets `Flag` take the bits of a report, which are an array."""

    def __call__(cls, value: Any, *args: Any, **options: Any) -> Any:
        # An enum would compare an array, which has no hash, with each of its members.
        if hasattr(value, "dtype"):
            if np.ndim(value):
                raise ValueError(
                    f"flags has shape {np.shape(value)}, expected (): for a stack of maps call "
                    "Flag with each element"
                )
            value = jax.device_get(value)
        if not args:
            try:
                value = operator.index(value)
            except TypeError as error:
                raise ValueError(
                    f"flags is {value!r}, expected an integer, as in a report"
                ) from error
        return super().__call__(value, *args, **options)


class Flag(enum.IntFlag, metaclass=_TakesArrays):
    """Problems of an update: bits of `Report.update_flags` and, for all updates, `Report.flags`.

    `Flag` takes these arrays as they are. For a stack of maps call it with each element.

    Example:
        >>> flags = hio.Flag(state.report.update_flags)
        >>> hio.Flag.BAD_POSE in flags
        False
        >>> print(flags)
        OUT_OF_RANGE|INCONSISTENT_CLOUD
    """

    BAD_POSE = 1
    """A pose was not finite, not rigid, or 100 km away. That update changed nothing else."""
    EMPTY_CLOUD = 2
    """A cloud had no finite row. That update changed nothing else."""
    POINTS_OUTSIDE = 4
    """Returns in range fell outside the bounds. Their rays cleared space but left no surface. Or
    surfaces of a map that was moved or merged fell outside, and are lost."""
    TRAINING_FAILED = 8
    """Training was not finite. The network was kept as it was, and the next update trains it again;
    the optimizer is reset if it was the cause."""
    OUT_OF_RANGE = 16
    """Almost no return was in range; see `Config.min_in_range`. That update changed nothing else:
    check the unit, which must be m."""
    INCONSISTENT_CLOUD = 32
    """A cloud contradicted the map as a whole. It was not fused, unless `Config.most_refusals`
    clouds in a row had been refused before it: check the pose and the sensor."""
    BAD_ARGUMENT = 64
    """Inside jit, `robot` or `noise` was not finite or out of range. That update changed nothing
    else."""
    NOT_REGISTERED = 128
    """`track` found no pose at which the cloud fits the map. It was not fused."""
    FUSED_AS_PREDICTED = 256
    """`track` fused the cloud at its predicted pose: the map was too young to register it."""

    def __str__(self) -> str:
        """Returns the names of the flags with `|` between them, or "none"."""
        names = [str(flag.name) for flag in type(self) if flag & self]
        unknown = int(self) & ~sum(type(self))
        return "|".join([*names, str(unknown)] if unknown else names) or "none"

    def __format__(self, spec: str) -> str:
        """Formats the names, as `str` does."""
        return format(str(self), spec)
