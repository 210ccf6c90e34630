"""What the command reads: a stream, exact distances, a configuration, a map to resume."""

from __future__ import annotations

import argparse
import contextlib
import math
from typing import TYPE_CHECKING, Any

from hiosdf_jax._src.command.failures import BAD_INPUT, NOTHING_MAPPED, Failure, checked

# Heavy imports are inside the functions, so that `hiosdf --help` responds at once.
if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np

    from hiosdf_jax._src.command.progress import SavedMap
    from hiosdf_jax._src.config import Config
    from hiosdf_jax._src.datasets.stream import Extent, Stream
    from hiosdf_jax._src.datasets.truth import GroundTruth

_AROUND_M = 3  # of the box that is mapped where no poses say how far the sensor moves

# A sensor whose returns have a mean direction longer than this looks in one direction: it is 0.8
# for a camera's view of 90 degrees, and 0.3 for a LiDAR on level ground.
_DIRECTED = 0.6


def open_inputs(options: argparse.Namespace) -> tuple[Stream, GroundTruth | None]:
    """Opens the stream, with the exact distances of its file unless others are given."""
    from hiosdf_jax._src.datasets.npz import NpzStream, read_truth
    from hiosdf_jax._src.datasets.stream import FrameStream

    stream, has_poses = _open(options)
    truth = None
    # Without poses nobody knows where the map is among exact distances.
    if isinstance(stream, NpzStream) and options.ground_truth is None and has_poses:
        truth = checked(lambda: read_truth(options.stream))
    if options.frames is not None:
        count = min(options.frames, len(stream))
        stamps = stamps_of(stream)
        stamps = None if stamps is None else stamps[:count]
        stream = FrameStream(options.stream, count, stream.__getitem__, stamps)
    return stream, truth


def _open(options: argparse.Namespace) -> tuple[Stream, bool]:
    """Opens the stream; for odometry also one without poses. Returns whether it has them."""
    from hiosdf_jax._src.datasets.open import open_stream
    from hiosdf_jax._src.datasets.stream import NoPosesError

    names = ("intrinsics", "trajectory", "cloud_topic", "odometry_topic", "world_frame")
    chosen = {name: getattr(options, name, None) for name in names}
    chosen = {name: value for name, value in chosen.items() if value is not None}

    def opened(poses: bool) -> Stream:
        return open_stream(options.stream, options.format, poses=poses, **chosen)

    try:
        return checked(lambda: opened(poses=True)), True
    except Failure as failure:
        if not isinstance(failure.__cause__, NoPosesError) or not hasattr(options, "odometry"):
            raise
        if not options.odometry:
            raise Failure(f"{failure}; --odometry maps a stream without poses", BAD_INPUT) from None
        if options.ground_truth is not None:
            raise Failure(f"{failure}: --ground-truth needs poses", BAD_INPUT) from None
    return checked(lambda: opened(poses=False)), False


def stamps_of(stream: Stream) -> np.ndarray | None:
    """The times of the frames, (F,) s, or None where the stream has none."""
    return getattr(stream, "stamps", None)


def complete(bounds: Any, options: argparse.Namespace, stream: Stream) -> tuple[Any, float]:
    """Completes bounds and range of the sensor in a first reading of the stream."""
    from hiosdf_jax._src.datasets.stream import find_bounds

    find = find_bounds_around_start if options.odometry else find_bounds
    extent = checked(
        lambda: find(stream, skip_bad_frames=options.skip_bad_frames), code=NOTHING_MAPPED
    )
    if options.odometry and bounds is None:
        print(
            f"--odometry uses no later poses: mapping {_AROUND_M} m around what the sensor sees "
            "from its first position (--bounds sets another box)"
        )
    bounds = bounds or extent.bounds
    if not math.isfinite(sum(map(sum, bounds)) + extent.max_range):
        raise Failure(
            "the returns are too far to find bounds, expected --bounds and --max-range", BAD_INPUT
        )
    max_range = options.max_range or math.ceil(10 * extent.max_range) / 10
    (x0, y0, z0), (x1, y1, z1) = bounds
    print(
        f"bounds x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}, z {z0:.1f} to {z1:.1f} m; "
        f"returns up to {max_range:.1f} m"
    )
    return bounds, max_range


def find_bounds_around_start(stream: Stream, *, skip_bad_frames: bool = False) -> Extent:
    """Finds the range of a sensor, and a box around its first position, without later poses.

    The box holds all clouds as they lie around the sensor, and 3 m more on each side. A sensor that
    looks in one direction, as a camera does, may turn around, so its box is a cube.

    Args:
        stream: The frames.
        skip_bad_frames: Skip bad frames.

    Returns:
        The bounds, in the world of the first usable frame's pose, and the range of the sensor.

    Raises:
        BadFrameError: A frame is bad and `skip_bad_frames` is False.
        ValueError: No frame is usable.
    """
    import numpy as np

    from hiosdf_jax._src.datasets.stream import FrameStream, find_bounds

    clouds = FrameStream("stream", len(stream), lambda i: (stream[i][0], np.eye(4)))
    extent = find_bounds(clouds, _AROUND_M, skip_bad_frames=skip_bad_frames)
    cloud, pose = _first_frame(stream)
    low, high = np.array(extent.bounds)
    center, half = (low + high) / 2, (high - low) / 2
    ranges = np.linalg.norm(cloud, axis=1, keepdims=True)
    seen = np.isfinite(ranges[:, 0]) & (ranges[:, 0] > 0)
    if np.linalg.norm(np.mean(cloud[seen] / ranges[seen], axis=0)) > _DIRECTED:
        center, half = pose[:3, 3], np.full(3, np.abs(extent.bounds).max())
    else:  # along the axes of the world, around the box along those of the sensor
        center, half = pose[:3, :3] @ center + pose[:3, 3], np.abs(pose[:3, :3]) @ half
    (x0, y0, z0), (x1, y1, z1) = (center - half).tolist(), (center + half).tolist()
    return extent._replace(bounds=((x0, y0, z0), (x1, y1, z1)))


def _first_frame(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """The cloud and the pose of the first usable frame."""
    from hiosdf_jax._src.datasets.stream import BadFrameError, read_frame

    for index in range(len(stream)):
        with contextlib.suppress(BadFrameError):
            return read_frame(stream, index)
    raise ValueError(f"none of the {len(stream)} frames can be used, expected at least one")


def truth_of_scene(
    file: Path, stream: Stream, max_range: float
) -> tuple[GroundTruth, Callable[[np.ndarray], np.ndarray]]:
    """Exact distances of a scene where the stream observed it, and the distances to draw."""
    from hiosdf_jax._src.scoring import scene, visible

    rays = checked(lambda: visible.read_rays(stream, max_range), code=NOTHING_MAPPED)
    exact = checked(lambda: scene.read_scene(file, visible.sensor_path(rays)))
    truth = checked(lambda: visible.sample_visible(exact, rays))
    return truth, exact.sdf_to_draw


def configure(name: str | None, bounds: Any, **overrides: float) -> Config:
    import jax

    from hiosdf_jax._src.config import Config

    if name is None:
        name = "light" if jax.default_backend() == "cpu" else "default"
    return checked(lambda: getattr(Config, name)(bounds, **overrides))


def resumed_map(options: argparse.Namespace) -> SavedMap | None:
    """The map to resume; raises a failure if it contradicts the other options."""
    if options.resume is None:
        return None
    from hiosdf_jax._src.command.progress import load_map
    from hiosdf_jax._src.config import Config

    resumed = checked(lambda: load_map(options.resume))
    config = resumed.state.config
    sizes = {"voxel_size": config.voxel_size, "max_range": config.max_range}
    known = {"seed": resumed.seed, "bounds": [*config.bounds[0], *config.bounds[1]]} | sizes
    for name, value in known.items():
        given = getattr(options, name, None)
        if given is not None and given != value:
            raise Failure(
                f"{option_name(name)} is {given}, expected {value} as in {options.resume}",
                BAD_INPUT,
            )
    if options.config and getattr(Config, options.config)(config.bounds, **sizes) != config:
        raise Failure(f"--config is {options.config}, not that of {options.resume}", BAD_INPUT)
    return resumed


def option_name(name: str) -> str:
    return "--" + name.replace("_", "-")


def seed_of(options: argparse.Namespace, resumed: SavedMap | None) -> int:
    return (options.seed or 0) if resumed is None else resumed.seed
