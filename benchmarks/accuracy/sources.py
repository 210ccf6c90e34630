"""The streams to measure on, with their truth and bounds."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from hiosdf_jax import datasets, scoring

# The parts of a mesh show which surface points are thin. The streams' truth does not.
_MESHES = {"house_depth": "small_house.ply", "house_lidar": "small_house.ply"}


class Source(NamedTuple):
    """A stream to measure on.

    Attributes:
        name: Name of the stream.
        stream: Its frames.
        truth: Exact distances; None for a real stream, which is scored on held-out frames.
        extent: Its bounds and range.
        complete: Whether all frames of the recording are in it.
    """

    name: str
    stream: datasets.Stream
    truth: scoring.GroundTruth | None
    extent: datasets.Extent
    complete: bool


def open_source(folder: Path, name: str, frames: int | None = None) -> Source:
    """Opens a stream.

    Args:
        folder: With NAME.npz.
        name: Name of the stream; "demo" is the simulated apartment.
        frames: How many frames to keep, from the first on; all if left out.

    Returns:
        The stream with its truth and its bounds.
    """
    if name == "demo":
        from hiosdf_jax import demo

        whole = demo.ApartmentStream()
        truth = demo.sample_truth(whole)
    else:
        whole = datasets.NpzStream(folder / f"{name}.npz")
        truth = datasets.read_truth(folder / f"{name}.npz")
    count = len(whole) if frames is None else min(frames, len(whole))
    stream = datasets.FrameStream(name, count, whole.__getitem__)
    extent = datasets.find_bounds(stream)
    complete = count == len(whole)
    if truth is not None and name in _MESHES and complete:
        truth = _with_thin_parts(folder / _MESHES[name], stream, truth, extent.max_range)
    return Source(name, stream, truth, extent, complete)


def _with_thin_parts(
    mesh: Path, stream: datasets.Stream, truth: scoring.GroundTruth, max_range: float
) -> scoring.GroundTruth:
    try:
        rays = scoring.read_rays(stream, max_range)
        scene = scoring.read_scene(mesh, scoring.sensor_path(rays))
    except (FileNotFoundError, ModuleNotFoundError) as error:
        print(f"thin parts are not scored: {error}")
        return truth
    drawn = scoring.sample_visible(scene, rays, count=len(stream))
    return truth._replace(thin_points_world=drawn.thin_points_world)
