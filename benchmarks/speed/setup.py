"""What a run measures: its sizes, its configurations and its stream."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from hiosdf_jax import datasets

Frame = tuple[np.ndarray, np.ndarray]  # cloud (N, 3) m in the sensor frame, T_world_sensor

_MAX_FRAMES = 200

# {label: preset and changes of its fields}. The one that needs the least memory comes first,
# because only the first peak is certainly that of its configuration.
CONFIGS: dict[str, tuple[str, dict[str, Any]]] = {
    "light": ("light", {}),
    "default": ("default", {}),
    "paper, slopes of 1 in 2": ("paper", {"eikonal_every": 2}),
    "paper": ("paper", {}),
}


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        configs: Labels of `CONFIGS`. The stages and the donated updates are those of the last.
        overrides: Fields to change in all configurations.
        paper_overrides: Fields to change in the paper's training beside PyTorch's.
        frames: Timed updates after those that warm up.
        seconds: How long to repeat each call.
        processes: How often the imports are timed.
        matrix_edge: Edge of the matrices whose product measures the machine.
        elements: float32 numbers of the arrays that measure the machine, more than a cache holds.
        queries: Points per query.
        baked_queries: Points per query of the baked field alone.
        bake_resolution: m.
        fleet: Small maps at once.
        cloud_sizes: Points per cloud.
        map_edges: Edges of square maps as high as the stream's bounds, m.
        endurance: Updates in a row.
        whole_run: Whether to run `hiosdf map` over the whole stream, and to extract its mesh.
    """

    configs: tuple[str, ...]
    overrides: dict[str, Any]
    paper_overrides: dict[str, Any]
    frames: int
    seconds: float
    processes: int
    matrix_edge: int
    elements: int
    queries: int
    baked_queries: int
    bake_resolution: float
    fleet: int
    cloud_sizes: tuple[int, ...]
    map_edges: tuple[float, ...]
    endurance: int
    whole_run: bool


FULL = Sizes(
    configs=tuple(CONFIGS),
    overrides={},
    paper_overrides={},
    frames=345,
    seconds=1.0,
    processes=5,
    matrix_edge=8192,
    elements=1 << 28,
    queries=102_400,
    baked_queries=1_048_576,
    bake_resolution=0.05,
    fleet=1024,
    cloud_sizes=(1_000, 16_000, 77_000, 300_000),
    map_edges=(10.0, 20.0, 60.0),
    endurance=10_000,
    whole_run=False,  # needs more packages than a GPU machine may have
)

QUICK = Sizes(
    configs=("light",),
    overrides={},
    paper_overrides={"epochs": 1},
    frames=10,
    seconds=0.3,
    processes=2,
    matrix_edge=1024,
    elements=1 << 26,
    queries=102_400,
    baked_queries=102_400,
    bake_resolution=0.2,
    fleet=8,
    cloud_sizes=(16_000, 77_000),
    map_edges=(10.0, 20.0),
    endurance=100,
    whole_run=True,
)


@dataclasses.dataclass(frozen=True)
class Setup:
    """What all tasks of a run have in common.

    Attributes:
        sizes: How much to measure.
        path: File of the stream.
        frames: Its frames, read beforehand.
        extent: Its bounds and range.
        deadline: When to stop, on the clock of `time.perf_counter`.
    """

    sizes: Sizes
    path: Path
    frames: list[Frame]
    extent: datasets.Extent
    deadline: float

    def config(self, label: str, **overrides: Any) -> hio.Config:
        """Makes a configuration of `CONFIGS` for the stream."""
        preset, changes = CONFIGS[label]
        values = {"max_range": self.extent.max_range} | changes | self.sizes.overrides | overrides
        bounds = values.pop("bounds", self.extent.bounds)
        return getattr(hio.Config, preset)(bounds, **values)

    def frame(self, index: int) -> Frame:
        """Returns a frame; the stream begins again at its end."""
        return self.frames[index % len(self.frames)]

    def is_over(self) -> bool:
        """Returns whether the deadline is past."""
        return time.perf_counter() > self.deadline


def open_setup(path: Path, sizes: Sizes, deadline: float) -> Setup:
    """Reads a stream, so that no reading is timed.

    Args:
        path: The stream, an .npz file.
        sizes: How much to measure.
        deadline: When to stop, on the clock of `time.perf_counter`.

    Returns:
        The setup.
    """
    stream = datasets.NpzStream(path)
    count = min(len(stream), _MAX_FRAMES)
    frames = [stream[k] for k in tqdm(range(count), desc="reading", unit="frame")]
    kept = datasets.FrameStream("frames", count, frames.__getitem__)
    return Setup(sizes, path, frames, datasets.find_bounds(kept), deadline)
