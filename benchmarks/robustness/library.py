"""Calls the map through its public functions, and passes on only what this version accepts."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio

_ACCEPTED = frozenset(inspect.signature(hio.update).parameters)
_CHUNK = 8192  # points per call, so that each question compiles once


class Frame(NamedTuple):
    """What one update is given.

    Attributes:
        cloud: (n, 3) m, sensor frame.
        pose: (4, 4) T_world_sensor.
        robot: Centers (k, 3) and radii (k,) m of the robot's spheres, world; None for no robot.
        noise: (a, b) of the sensor's error a + b r^2, m and 1/m; None for the configuration's.
    """

    cloud: np.ndarray
    pose: np.ndarray
    robot: tuple[np.ndarray, np.ndarray] | None = None
    noise: tuple[float, float] | None = None


class Played(NamedTuple):
    """A map after some updates.

    Attributes:
        state: The map.
        flags: The flags of each update by itself, as bits of `hio.Flag`.
        refused: The message of each update that raised a ValueError and left the map as it was.
    """

    state: hio.MapState
    flags: list[int]
    refused: list[str | None]


class Setup(NamedTuple):
    """What all scenarios share.

    Attributes:
        config_name: "light", "default" or "paper".
        seed: Source of all randomness.
    """

    config_name: str
    seed: int

    def config(self, bounds: Any, max_range: float) -> hio.Config:
        """The configuration for a box and a sensor's range, m."""
        return getattr(hio.Config, self.config_name)(bounds, max_range=max_range)

    def rng(self, *place: int) -> np.random.Generator:
        """A generator for one scan or purpose, independent of all others."""
        return np.random.default_rng((self.seed, *place))

    def new_map(self, config: hio.Config) -> hio.MapState:
        """An empty map."""
        return hio.init(config, jax.random.key(self.seed))


def accepts(argument: str) -> bool:
    """Whether `hio.update` has an argument of this name."""
    return argument in _ACCEPTED


def moving_rows(before: hio.MapState, after: hio.MapState, frame: Frame) -> np.ndarray | None:
    """A mask of the rows of a cloud that the map calls moving.

    Args:
        before: The map before the update.
        after: The map after it.
        frame: What the update was given.

    Returns:
        (n,) bool; None if this version has no such function.
    """
    del after
    find = getattr(hio, "moving_rows", None)
    return None if find is None else np.asarray(find(before, frame.cloud, frame.pose))


def play(
    state: hio.MapState,
    frames: Iterable[Frame],
    name: str,
    after: Callable[[int, hio.MapState, hio.MapState], None] | None = None,
) -> Played:
    """Updates a map with frames.

    Args:
        state: The map; it stays valid.
        frames: The frames.
        name: Label of the progress bar.
        after: Called with the number of each frame, the map before and the map after it.

    Returns:
        The map after them.
    """
    flags, refused = [], []
    for index, frame in enumerate(tqdm(frames, desc=name, unit="update", leave=False)):
        # Sticky flags are cleared before each update, so that each shows only its own flags.
        report = state.report.replace(flags=jnp.zeros_like(state.report.flags))
        extras: dict[str, Any] = {
            key: value
            for key, value in (("robot", frame.robot), ("noise", frame.noise))
            if value is not None and accepts(key)
        }
        before = state
        try:
            state = hio.update(state.replace(report=report), frame.cloud, frame.pose, **extras)
            flags.append(int(state.report.flags))
            refused.append(None)
        except ValueError as error:
            flags.append(0)
            refused.append(str(error))
        if after is not None:
            after(index, before, state)
    return Played(state, flags, refused)


def flag_names(bits: Iterable[int]) -> list[str]:
    """Names of all flags in some bit masks."""
    raised = 0
    for each in bits:
        raised |= each
    return [flag.name or str(flag.value) for flag in hio.Flag if raised & flag]


def sdf(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Distances (n,) m at points (n, 3) m; where nothing has been seen, the map's own guess."""
    return _in_chunks(lambda chunk: hio.sdf(state, chunk, "network"), points)


def solid_sdf(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Distances (n,) m at points (n, 3) m, with unseen space as an obstacle."""
    return _in_chunks(lambda chunk: hio.sdf(state, chunk, "obstacle"), points)


def network_sdf(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Distances (n,) m at points (n, 3) m by the network alone."""
    alone = state.replace(config=dataclasses.replace(state.config, grid_share=0.0))
    return sdf(alone, points)


def lower(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Lower bounds (n,) m of the distance at points (n, 3) m."""
    return _in_chunks(lambda chunk: hio.query(state, chunk).lower, points)


def frontier(state: hio.MapState, points: np.ndarray) -> np.ndarray:
    """Distances (n,) m to unseen space at points (n, 3) m, negative in it."""
    return _in_chunks(lambda chunk: hio.query(state, chunk).frontier, points)


def solid_sdf_and_grad(state: hio.MapState, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) m and gradients (n, 3) at points, with unseen space as an obstacle."""
    value, grad = hio.sdf_and_grad(state, np.asarray(points, np.float32), "obstacle")
    return np.asarray(value), np.asarray(grad)


def is_finite(state: hio.MapState) -> bool:
    """Whether all numbers of a map, the optimizer's among them, are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)


def _in_chunks(query: Callable[[np.ndarray], Any], points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float32)
    answers = np.empty(len(points))
    for start in range(0, len(points), _CHUNK):
        chunk = points[start : start + _CHUNK]
        padded = np.zeros((_CHUNK, 3), np.float32)
        padded[: len(chunk)] = chunk
        answers[start : start + _CHUNK] = np.asarray(query(padded))[: len(chunk)]
    return answers
