"""What the command reads: a stream, exact distances, a configuration, a map to resume."""

from __future__ import annotations

import argparse
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
    from hiosdf_jax._src.datasets.stream import Stream
    from hiosdf_jax._src.datasets.truth import GroundTruth


def open_inputs(options: argparse.Namespace) -> tuple[Stream, GroundTruth | None]:
    """Opens the stream, with the exact distances of its file unless others are given."""
    from hiosdf_jax._src.datasets.npz import NpzStream, read_truth
    from hiosdf_jax._src.datasets.open import open_stream
    from hiosdf_jax._src.datasets.stream import FrameStream

    names = ("intrinsics", "trajectory", "cloud_topic", "odometry_topic", "world_frame")
    chosen = {name: getattr(options, name, None) for name in names}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    stream = checked(lambda: open_stream(options.stream, options.format, **chosen))
    truth = None
    if isinstance(stream, NpzStream) and options.ground_truth is None:
        truth = checked(lambda: read_truth(options.stream))
    if options.frames is not None:
        count = min(options.frames, len(stream))
        stream = FrameStream(options.stream, count, stream.__getitem__)
    return stream, truth


def complete(bounds: Any, options: argparse.Namespace, stream: Stream) -> tuple[Any, float]:
    """Completes bounds and range of the sensor in a first reading of the stream."""
    from hiosdf_jax._src.datasets.stream import find_bounds

    extent = checked(
        lambda: find_bounds(stream, skip_bad_frames=options.skip_bad_frames), code=NOTHING_MAPPED
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


def sample_truth(
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
