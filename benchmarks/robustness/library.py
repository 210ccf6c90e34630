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
        refused: The messages of updates that raised a ValueError and left the map as it was.
    """

    state: hio.MapState
    flags: list[int]
    refused: list[str]


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


def play(
    state: hio.MapState,
    frames: Iterable[Frame],
    name: str,
    after: Callable[[int, hio.MapState], None] | None = None,
) -> Played:
    """Updates a map with frames.

    Args:
        state: The map; it stays valid.
        frames: The frames.
        name: Label of the progress bar.
        after: Called with the number of each frame and the map after it.

    Returns:
        The map after them.
    """
    flags, refused = [], []
    for index, frame in enumerate(tqdm(frames, desc=name, unit="update", leave=False)):
        # Sticky flags are cleared before each update, so that each tells of itself.
        report = state.report.replace(flags=jnp.zeros_like(state.report.flags))
        extras = {
            key: value
            for key, value in (("robot", frame.robot), ("noise", frame.noise))
            if value is not None and accepts(key)
        }
        try:
            state = hio.update(state.replace(report=report), frame.cloud, frame.pose, **extras)
            flags.append(int(state.report.flags))
        except ValueError as error:
            refused.append(str(error))
            flags.append(0)
        if after is not None:
            after(index, state)
    return Played(state, flags, refused)


def flag_names(bits: Iterable[int]) -> list[str]:
    """Names of all flags in some bit masks."""
    raised = 0
    for each in bits:
        raised |= each
    return [flag.name or str(flag.value) for flag in hio.Flag if raised & flag]


class Answers(NamedTuple):
    """What a map says of points, numpy.

    Attributes:
        sdf: (n,) m, where nothing has been seen the map's own guess.
        solid: (n,) m, the distance under unknown="obstacle".
        solid_grad: (n, 3), its gradient.
        lower: (n,) m.
        network: (n,) m, by the network alone.
    """

    sdf: np.ndarray
    solid: np.ndarray
    solid_grad: np.ndarray
    lower: np.ndarray
    network: np.ndarray


def ask(state: hio.MapState, points: np.ndarray) -> Answers:
    """Asks a map about points.

    Args:
        state: The map.
        points: (n, 3) m, world.

    Returns:
        Its answers.
    """
    points = np.asarray(points, np.float32)
    parts = []
    for start in range(0, max(len(points), 1), _CHUNK):
        chunk = points[start : start + _CHUNK]
        padded = np.zeros((_CHUNK, 3), np.float32)
        padded[: len(chunk)] = chunk
        parts.append([np.asarray(each)[: len(chunk)] for each in _ask(state, padded)])
    return Answers(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def push_out(
    state: hio.MapState, points: np.ndarray, margin: float, step: float, count: int
) -> np.ndarray:
    """Moves points up the gradient as a trajectory optimizer does, until they are clear.

    Args:
        state: The map, asked under unknown="obstacle".
        points: (n, 3) m, world.
        margin: m; a point with a larger distance is clear and stays.
        step: m.
        count: The largest number of steps.

    Returns:
        (n, 3) m.
    """
    points = np.asarray(points, np.float32)
    for _ in range(count):
        sdf, grad = (np.asarray(each) for each in hio.sdf_and_grad(state, points, "obstacle"))
        length = np.maximum(np.linalg.norm(grad, axis=1), 1e-9)
        points = points + np.where(sdf < margin, step / length, 0)[:, None] * grad
    return points


def is_finite(state: hio.MapState) -> bool:
    """Whether all numbers of a map, the optimizer's among them, are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)


def _ask(state: hio.MapState, points: np.ndarray) -> tuple[Any, ...]:
    obstacle = hio.query(state, points, unknown="obstacle")
    config = dataclasses.replace(state.config, grid_share=0.0)
    return (
        hio.sdf(state, points, unknown="network"),
        obstacle.sdf,
        obstacle.grad,
        obstacle.lower,
        hio.sdf(state.replace(config=config), points, unknown="network"),
    )
