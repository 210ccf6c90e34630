"""The streams to measure on, with their truth and bounds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hiosdf_jax import datasets, scoring

# A mesh shows which surface points are thin, and how far any point is from the surface.
_MESHES = {"house_depth": "small_house.ply", "house_lidar": "small_house.ply"}


class Source(NamedTuple):
    """A stream to measure on.

    Attributes:
        name: Name of the stream.
        stream: Its frames.
        truth: Exact distances; None for a real stream, which is scored on held-out frames.
        extent: Its bounds and range.
        complete: Whether all frames of the recording are in it.
        distance: Maps points (n, 3) m to their distances from the exact surface, (n,) m; None where
            only samples of it are known.
    """

    name: str
    stream: datasets.Stream
    truth: scoring.GroundTruth | None
    extent: datasets.Extent
    complete: bool
    distance: Callable[[np.ndarray], np.ndarray] | None = None


def open_source(folder: Path, name: str, frames: int | None = None) -> Source:
    """Opens a stream.

    Args:
        folder: With NAME.npz.
        name: Name of the stream; "demo" is the simulated apartment.
        frames: How many frames to keep, from the first on; all if left out.

    Returns:
        The stream with its truth and its bounds.
    """
    distance: Callable[[np.ndarray], np.ndarray] | None = None
    if name == "demo":
        from hiosdf_jax import demo

        whole = demo.ApartmentStream()
        truth = demo.sample_truth(whole)
        distance = _distance_in_demo(demo.load_model())
    else:
        whole = datasets.NpzStream(folder / f"{name}.npz")
        truth = datasets.read_truth(folder / f"{name}.npz")
    count = len(whole) if frames is None else min(frames, len(whole))
    stream = datasets.FrameStream(name, count, whole.__getitem__)
    extent = datasets.find_bounds(stream)
    complete = count == len(whole)
    if truth is not None and name in _MESHES and complete:
        truth, distance = _with_mesh(folder / _MESHES[name], stream, truth, extent.max_range)
    return Source(name, stream, truth, extent, complete, distance)


def _with_mesh(
    mesh: Path, stream: datasets.Stream, truth: scoring.GroundTruth, max_range: float
) -> tuple[scoring.GroundTruth, Callable[[np.ndarray], np.ndarray] | None]:
    """Adds points on thin parts to a truth, and returns the distance from the mesh."""
    try:
        rays = scoring.read_rays(stream, max_range)
        scene = scoring.read_scene(mesh, scoring.sensor_path(rays))
    except (FileNotFoundError, ModuleNotFoundError) as error:
        print(f"thin parts and meshes are not scored: {error}")
        return truth, None
    drawn = scoring.sample_visible(scene, rays, count=len(stream))
    return truth._replace(thin_points_world=drawn.thin_points_world), scene.sdf_to_draw


def _distance_in_demo(model: Any) -> Callable[[np.ndarray], np.ndarray]:
    from hiosdf_jax import demo

    return lambda points_world: demo.signed_distance(model, points_world)[0]
