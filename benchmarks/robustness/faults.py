"""Faults injected into a clean stream: steady faults, and bursts after which it continues."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hiosdf_jax as hio
from benchmarks.robustness import library, measures
from benchmarks.robustness.library import Frame, Played, Setup
from benchmarks.robustness.scenes import (
    BOUNDS,
    MAX_RANGE,
    ROOM,
    TOUR,
    frames_of,
    scan_all,
    touring_path,
)
from benchmarks.robustness.sensors import depth_camera
from benchmarks.robustness.worlds import World

Rows = dict[str, measures.Figures]

_HOUSE_FRAMES = 60
_BURST_AFTER = 30  # frames
_JUDGED_FROM = 5  # updates; a younger map refuses nothing
_POOR_NOISE = 0.05  # m
_LENS = 0.12  # m, how near the thing is that covers the lens
_THROUGH_CLEAR, _THROUGH_TRUTH = 0.1, 0.05  # m, called clear and truly near
_LOWER_EXCESS = 0.005  # m
_FEET = 3.28  # per m


@dataclasses.dataclass(frozen=True, eq=False)
class Stream:
    """A clean stream and the truth about it.

    Attributes:
        name: Name of the stream.
        bounds: Two corners of the mapped box, m.
        max_range: m.
        frames: Its frames.
        points: (n, 3) m, seen free points of the world.
        truth: (n,) m, exact distances there.
    """

    name: str
    bounds: Any
    max_range: float
    frames: list[Frame]
    points: np.ndarray
    truth: np.ndarray


class Clean(NamedTuple):
    """What the clean stream gives.

    Attributes:
        half: The map after `_BURST_AFTER` frames.
        whole: The map after all.
        flags: The flags that are no alarm: those of any of its updates, and POINTS_OUTSIDE.
    """

    half: hio.MapState
    whole: hio.MapState
    flags: int


def open_stream(setup: Setup, folder: Path) -> Stream:
    """Opens house_depth, or the analytic room where there is no such file.

    Args:
        setup: Source of randomness.
        folder: Where house_depth.npz may be.

    Returns:
        The stream.
    """
    path = folder / "house_depth.npz"
    return _house(setup, path) if path.is_file() else _room(setup)


def run_faults(setup: Setup, folder: Path) -> Rows:
    """Every fault, on the same clean stream."""
    stream = open_stream(setup, folder)
    half = _play(setup, stream, None, stream.frames[:_BURST_AFTER], "clean")
    rest = _play(setup, stream, half.state, stream.frames[_BURST_AFTER:], "clean")
    harmless = _union([*half.flags, *rest.flags, hio.Flag.POINTS_OUTSIDE])
    clean = Clean(half.state, rest.state, harmless)
    rows = {
        f"{stream.name}: clean": measures.errors(clean.whole, stream.points, stream.truth)
        | {"false_alarms": _flagged([*half.flags, *rest.flags], hio.Flag.POINTS_OUTSIDE)}
        | measures.bounds_hold(clean.whole, stream.points, stream.truth)
    }
    for label, burst in BURSTS.items():
        frames = burst(stream, setup.rng(5))
        during = _play(setup, stream, clean.half, frames, label)
        after = _play(setup, stream, during.state, stream.frames[_BURST_AFTER:], label)
        rows[f"{stream.name}: {label}"] = (
            _score(stream, clean, after.state)
            | _alarm(clean, during)
            | {"false_alarms": _flagged(after.flags, clean.flags)}
        )
    for label, (spoil, noise) in STEADY.items():
        frames = [
            spoil(frame, k, setup.rng(6, k))._replace(noise=noise(k))
            for k, frame in enumerate(stream.frames)
        ]
        played = _play(setup, stream, None, frames, label)
        rows[f"{stream.name}: {label}"] = _score(stream, clean, played.state) | {
            "false_alarms": _flagged(played.flags, clean.flags)
        }
    rows |= _each_frame_displaced(setup, stream, clean)
    rows |= _millimeters_from_the_start(setup, stream, clean)
    rows |= _out_of_range(setup, stream, clean)
    return rows


def _millimeters_from_the_start(setup: Setup, stream: Stream, clean: Clean) -> Rows:
    label = "millimeters from the start"
    played = _play(setup, stream, None, _scaled(stream.frames[:10], 1000), label)
    return {f"{stream.name}: {label}": {"flagged_first": _alarm(clean, played, 1)["flagged"]}}


def _out_of_range(setup: Setup, stream: Stream, clean: Clean) -> Rows:
    """The whole stream, and then all of it again, so scaled that no return is in range."""
    label = "then all beyond max_range"
    played = _play(setup, stream, clean.whole, _scaled(stream.frames, 1000), label)
    return {f"{stream.name}: {label}": _score(stream, clean, played.state) | _alarm(clean, played)}


def _random_clouds(stream: Stream, rng: np.random.Generator, count: int) -> list[Frame]:
    pose = stream.frames[_BURST_AFTER - 1].pose
    low, high = np.array(stream.bounds)
    frames = []
    for _ in range(count):
        points_world = rng.uniform(low, high, (20_000, 3))
        cloud = (points_world - pose[:3, 3]) @ pose[:3, :3]
        frames.append(Frame(cloud.astype(np.float32), pose))
    return frames


def _displaced(stream: Stream, rng: np.random.Generator) -> list[Frame]:
    heading = rng.uniform(0, 2 * np.pi)
    return [_moved(frame, heading) for frame in stream.frames[_BURST_AFTER - 5 : _BURST_AFTER]]


def _moved(frame: Frame, heading: float) -> Frame:
    """A frame whose pose is 1 m off along the floor."""
    pose = np.array(frame.pose)
    pose[:3, 3] += [np.cos(heading), np.sin(heading), 0]
    return frame._replace(pose=pose)


def _each_frame_displaced(setup: Setup, stream: Stream, clean: Clean) -> Rows:
    """Updates a copy of the map with each frame at a pose 1 m off, once the map can judge it."""
    label = "each frame 1 m off"
    flags = []

    def look(index: int, before: hio.MapState, _: hio.MapState) -> None:
        if index >= _JUDGED_FROM:
            wrong = _moved(stream.frames[index], setup.rng(7, index).uniform(0, 2 * np.pi))
            flags.extend(library.play(before, [wrong], f"{stream.name}: {label}").flags)

    state = setup.new_map(setup.config(stream.bounds, stream.max_range))
    library.play(state, stream.frames, f"{stream.name}: {label}", look)
    return {f"{stream.name}: {label}": {"flagged": _flagged(flags, clean.flags)}}


def _covered(stream: Stream, rng: np.random.Generator) -> list[Frame]:
    """Something flat at 12 cm in front of the lens."""
    frames = []
    for frame in stream.frames[_BURST_AFTER - 5 : _BURST_AFTER]:
        depth = _LENS + 0.002 * rng.normal(size=(len(frame.cloud), 1))
        cloud = (frame.cloud / frame.cloud[:, 2:] * depth).astype(np.float32)
        frames.append(frame._replace(cloud=cloud))
    return frames


def _far_pose(stream: Stream, rng: np.random.Generator) -> list[Frame]:
    frame = stream.frames[_BURST_AFTER - 1]
    pose = np.array(frame.pose)
    pose[:3, 3] = 1e20
    return [frame._replace(pose=pose)]


BURSTS: dict[str, Callable[[Stream, np.random.Generator], list[Frame]]] = {
    "10 random clouds": lambda stream, rng: _random_clouds(stream, rng, 10),
    "30 random clouds": lambda stream, rng: _random_clouds(stream, rng, 30),
    "10 clouds in millimeters": lambda stream, _: _scaled(_late(stream), 1000),
    "10 clouds 1.3 times as long": lambda stream, _: _scaled(_late(stream), 1.3),
    "10 clouds in feet": lambda stream, _: _scaled(_late(stream), _FEET),
    "5 frames 1 m off": _displaced,
    "lens covered for 5 frames": _covered,
    "a pose 1e20 m away": _far_pose,
}


def _outliers(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    """5 % of the returns at any range along their rays."""
    wrong = rng.uniform(size=len(frame.cloud)) < 0.05
    ranges = rng.uniform(0.3, 6.0, len(frame.cloud))
    cloud = np.where(wrong[:, None], _directions(frame.cloud) * ranges[:, None], frame.cloud)
    return frame._replace(cloud=cloud.astype(np.float32))


def _drop_outs(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    lost = rng.uniform(size=len(frame.cloud)) < 0.3
    return frame._replace(cloud=np.where(lost[:, None], np.float32(np.nan), frame.cloud))


def _poor_ranges(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    offsets = _POOR_NOISE * rng.normal(size=(len(frame.cloud), 1))
    cloud = frame.cloud + offsets * _directions(frame.cloud)
    return frame._replace(cloud=cloud.astype(np.float32))


def _every_other_poor(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    return _poor_ranges(frame, number, rng) if number % 2 else frame


def _poor_pose(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    """A pose that is off by 2 cm and 1 degree (standard deviations) in random directions."""
    angle, length = np.radians(1.0) * rng.normal(), 0.02 * rng.normal()
    (x, y, z), heading = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    pose = np.array(frame.pose, np.float64)
    pose[:3, :3] = pose[:3, :3] @ turn
    pose[:3, 3] += length * heading
    return frame._replace(pose=pose)


_UNKNOWN_NOISE: Callable[[int], Any] = lambda number: None  # noqa: E731
_KNOWN_NOISE: Callable[[int], Any] = lambda number: (_POOR_NOISE, 0.0)  # noqa: E731

Spoil = Callable[[Frame, int, np.random.Generator], Frame]
# {label: (what is done to each frame, the noise that is given with it)}
STEADY: dict[str, tuple[Spoil, Callable[[int], Any]]] = {
    "5 % outliers": (_outliers, _UNKNOWN_NOISE),
    "30 % drop-outs": (_drop_outs, _UNKNOWN_NOISE),
    "5 cm noise": (_poor_ranges, _KNOWN_NOISE),
    "5 cm noise every other frame": (
        _every_other_poor,
        lambda number: (_POOR_NOISE, 0.0) if number % 2 else None,
    ),
    "poses 2 cm and 1 degree off": (_poor_pose, _UNKNOWN_NOISE),
}


def _late(stream: Stream) -> Sequence[Frame]:
    return stream.frames[_BURST_AFTER - 10 : _BURST_AFTER]


def _scaled(frames: Sequence[Frame], factor: float) -> list[Frame]:
    return [frame._replace(cloud=(factor * frame.cloud).astype(np.float32)) for frame in frames]


def _directions(cloud: np.ndarray) -> np.ndarray:
    return cloud / np.linalg.norm(cloud, axis=1, keepdims=True)


def _play(
    setup: Setup, stream: Stream, state: hio.MapState | None, frames: Sequence[Frame], label: str
) -> Played:
    if state is None:
        state = setup.new_map(setup.config(stream.bounds, stream.max_range))
    return library.play(state, frames, f"{stream.name}: {label}")


def _score(stream: Stream, clean: Clean, state: hio.MapState) -> measures.Figures:
    sdf = library.sdf(state, stream.points)
    lower = library.lower(state, stream.points)
    through = (sdf > _THROUGH_CLEAR) & (stream.truth < _THROUGH_TRUTH)
    return (
        measures.error_ratio(state, clean.whole, stream.points, stream.truth)
        | measures.bounds_hold(state, stream.points, stream.truth)
        | {
            "finite": float(library.is_finite(state)),
            "through_walls": float(np.mean(through)),
            "lower_excess": float(np.mean(lower > stream.truth + _LOWER_EXCESS)),
        }
    )


def _alarm(clean: Clean, played: Played, first: int | None = None) -> measures.Figures:
    """`flagged`, the share of updates that were refused or raised a flag that is no clean one."""
    alarms = [
        refused is not None or bool(flags & ~clean.flags)
        for flags, refused in zip(played.flags, played.refused, strict=True)
    ]
    return {"flagged": float(np.mean(alarms[:first]))}


def _flagged(flags: Sequence[int], harmless: int) -> float:
    return float(np.mean([bool(each & ~harmless) for each in flags]))


def _union(flags: Sequence[int]) -> int:
    return int(np.bitwise_or.reduce(np.array(flags, np.int64)))


def _house(setup: Setup, path: Path) -> Stream:
    from hiosdf_jax import datasets

    whole = datasets.NpzStream(path)
    stream = datasets.FrameStream("house_depth", _HOUSE_FRAMES, whole.__getitem__)
    extent = datasets.find_bounds(stream)
    truth = datasets.read_truth(path)
    assert truth is not None
    seen = truth.frame < _HOUSE_FRAMES
    frames = []
    for k in range(_HOUSE_FRAMES):
        cloud, pose = datasets.read_frame(stream, k)
        # Which rows of a large cloud are drawn depends on their order.
        frames.append(Frame(setup.rng(0, k).permutation(np.asarray(cloud)), np.asarray(pose)))
    return Stream(
        "house", extent.bounds, extent.max_range, frames, truth.points_world[seen], truth.sdf[seen]
    )


def _room(setup: Setup) -> Stream:
    sensor, world = depth_camera(), World(ROOM)
    scans = scan_all(setup, sensor, lambda _: world, range(TOUR), touring_path)
    points, truth = measures.seen_points(sensor, scans, world, setup.rng(1))
    return Stream("room", BOUNDS, MAX_RANGE, frames_of(scans), points, truth)
