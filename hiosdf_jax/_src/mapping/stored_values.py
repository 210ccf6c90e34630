"""The values that a saved map can have: those that updates can give it."""

from __future__ import annotations

import os

import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.evidence import is_observed
from hiosdf_jax._src.numerics.rigid import FARTHEST_M
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import FRONTIER_STEPS, NO_FEATURE, Grid, Side

_Path = str | os.PathLike[str]

_MOST_HALF = 65504  # what float16 holds
_MOST_COUNT = 2**30  # updates add 1 to it
_MOST_WEIGHT = 1e6  # of the network, and of the optimizer's moments

# Names as they are in a file. Distances in the grid are at most 127 voxels of 10 m along each axis,
# and the calibration divides them by 0.3 voxels or more.
_LIMITS = {
    "grid.hits": (0, _MOST_HALF),
    "grid.behind": (0, _MOST_HALF),
    "grid.weight": (0, _MOST_HALF),
    "grid.change": (-72, 8),
    "grid.surface.mean": (-1, 1),
    "grid.surface.axes": (-1, 1),
    "grid.surface.nearest": (NO_FEATURE, 127),
    "grid.surface.sdf": (-2200, 2200),
    "grid.surface.doubt": (0, 2200),
    "grid.surface.frontier": (-FRONTIER_STEPS, FRONTIER_STEPS),
    "grid.surface.side": (min(Side), max(Side)),
    "network.optimizer.0.count": (0, _MOST_COUNT),
    "network.origin_world": (-FARTHEST_M, FARTHEST_M),
    "optimism": (0, 424),
    "updates": (0, _MOST_COUNT),
    "report.flags": (0, sum(Flag)),
    "report.update_flags": (0, sum(Flag)),
    "report.refused_in_row": (0, _MOST_COUNT),
    # Those of a training that failed are not finite.
    "report.sdf_loss": (0, np.inf),
    "report.eikonal_loss": (0, np.inf),
}
_LIMITS_OF_MANY = {  # by the beginning of the name
    "network.optimizer.0.nu.": (0, _MOST_WEIGHT),
    "network.": (-_MOST_WEIGHT, _MOST_WEIGHT),
    "report.points_": (0, 2**31 - 1),
}
_ROUNDING = 1.001  # of float16


def check_array(path: _Path, name: str, array: np.ndarray) -> None:
    """Checks the values of one array.

    Args:
        path: The file, for messages.
        name: The array's name in it.
        array: The array.

    Raises:
        ValueError: Some are not finite, or such as no map has.
    """
    many = (limits for start, limits in _LIMITS_OF_MANY.items() if name.startswith(start))
    least, most = _LIMITS.get(name) or next(many, (-np.inf, np.inf))
    if array.dtype.kind == "f":
        finite = np.isfinite(array)
        if name in ("report.sdf_loss", "report.eikonal_loss"):
            array = array[finite]
        elif not finite.all():
            raise ValueError(f"{path} has {name} with values that are not finite")
    if array.size and not (array.min() >= least and array.max() <= most):
        raise ValueError(
            f"{path} has {name} from {array.min()} to {array.max()}, expected {least} to {most}"
        )


def check_grid(path: _Path, config: Config, grid: Grid) -> None:
    """Checks that the distances of a grid fit its evidence.

    Args:
        path: The file, for messages.
        config: The map's configuration.
        grid: The grid, whose arrays are in range.

    Raises:
        ValueError: A nearest patch lies outside of the grid or is none, a voxel without one has
            another distance than the horizon, a distance is beyond the horizon, or the frontier
            has the wrong sign.
    """
    farthest = (config.horizon_voxels + 1) * config.voxel_size  # a patch reaches into its voxel
    horizon = np.float16(config.distance_horizon)
    hits = np.asarray(grid.evidence.hits)
    y, z = np.ogrid[: hits.shape[1], : hits.shape[2]]
    for x in range(len(hits)):  # plane by plane, so that large maps take little more memory
        nearest, sdf, side, doubt, steps = (
            np.asarray(array[x])
            for array in (
                grid.derived.nearest,
                grid.derived.sdf,
                grid.derived.side,
                grid.derived.doubt,
                grid.derived.frontier_steps,
            )
        )
        none = (nearest == NO_FEATURE).all(axis=-1)
        target = [here + nearest[..., k].astype(int) for k, here in enumerate((x, y, z))]
        inside = np.logical_and.reduce(
            [(each >= 0) & (each < size) for each, size in zip(target, hits.shape, strict=True)]
        )
        chosen = tuple(np.where(inside, each, 0) for each in target)
        if not (none | (inside & (hits[chosen] >= config.min_hits))).all():
            raise ValueError(f"{path} has grid.surface.nearest without a patch there")
        if not (~none | ((sdf == horizon) & (side == Side.UNKNOWN))).all():
            raise ValueError(f"{path} has grid.surface.sdf without a patch, expected {horizon} m")
        if not (np.abs(sdf) <= _ROUNDING * farthest).all():
            raise ValueError(f"{path} has grid.surface.sdf beyond {farthest:g} m")
        if not (doubt <= _ROUNDING * config.distance_horizon).all():
            raise ValueError(f"{path} has grid.surface.doubt beyond {horizon:g} m")
        passes, behind = (
            np.asarray(counts[x], np.float32)
            for counts in (grid.evidence.passes, grid.evidence.behind)
        )
        observed = is_observed(config, passes, hits[x].astype(np.float32), behind)
        if not ((steps >= 0) == observed).all():
            raise ValueError(
                f"{path} has grid.surface.frontier of the wrong sign, expected one >= 0 in the "
                "voxels that rays have observed and < 0 elsewhere"
            )
