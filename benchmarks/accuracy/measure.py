"""Maps a stream and scores, along the way and at its end, three ways of asking the map."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from hiosdf_jax import datasets
from hiosdf_jax._src.command import run
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.field.points import as_field
from hiosdf_jax._src.grid import lookup
from hiosdf_jax._src.scoring import metrics
from hiosdf_jax._src.state import Field

# Forgetting is the error in the region of so many first frames, right after them and at the end.
EARLY_FRAMES = 20

# Parts of a mesh tell which surface points are on thin things; the streams' own truth does not.
_MESHES = {"house_depth": "small_house.ply", "house_lidar": "small_house.ply"}

_HELD_OUT_SEED = 0


class Source(NamedTuple):
    """A stream to measure on.

    Attributes:
        name: Of the stream.
        stream: Its frames.
        truth: Exact distances; None for a real stream, which is scored on frames held out.
        extent: Its bounds and range.
        complete: No frame was left off its end.
    """

    name: str
    stream: datasets.Stream
    truth: metrics.GroundTruth | None
    extent: datasets.Extent
    complete: bool


def open_source(folder: Path, name: str, frames: int | None = None) -> Source:
    """Opens a stream.

    Args:
        folder: With NAME.npz.
        name: Of the stream; "demo" is the simulated apartment.
        frames: Only the first so many.

    Returns:
        The stream, with what one pass over it tells.
    """
    if name == "demo":
        from hiosdf_jax import demo

        whole = demo.ApartmentStream()
        truth = demo.sample_truth(whole)
    else:
        whole = datasets.NpzStream(folder / f"{name}.npz")
        truth = datasets.ground_truth(folder / f"{name}.npz")
    count = len(whole) if frames is None else min(frames, len(whole))
    stream = datasets.FrameStream(name, count, whole.__getitem__)
    extent = datasets.find_bounds(stream)
    complete = count == len(whole)
    if truth is not None and name in _MESHES and complete:
        truth = _with_thin_parts(folder / _MESHES[name], stream, truth, extent.max_range)
    return Source(name, stream, truth, extent, complete)


def measure(
    source: Source, config_name: str, seed: int, every: int, overrides: dict[str, Any]
) -> dict[str, Any]:
    """Maps a stream and scores the map.

    Args:
        source: The stream.
        config_name: "light", "paper" or "default".
        seed: Of the map's randomness, and of the order of the clouds' rows.
        every: The map is scored after each so many frames, and after the last.
        overrides: Fields of the configuration to change.

    Returns:
        A record for JSON: what was run, times, and `variants`: by grid, network and served the
        `scores`, the scores by band of true distance as `bands`, and the scores `over_time`.
    """
    extent = source.extent
    config = getattr(hio.Config, config_name)(
        extent.bounds, **({"max_range": extent.max_range} | overrides)
    )
    count = len(source.stream)
    held_out = run.held_out_frames(count) if source.truth is None else range(0)
    held_out_world = _returns_of(source.stream, held_out, config)
    mapped = [frame for frame in range(count) if frame not in held_out]
    state = hio.init(config, jax.random.key(seed))
    order = np.random.default_rng(seed)
    times_ms = []
    variants = {name: {"scores": {}, "bands": {}, "over_time": []} for name in VARIANTS}
    early: dict[str, float] = {}
    for frame in tqdm(mapped, desc=f"{source.name} {config_name} seed {seed}", unit="frame"):
        cloud, pose = datasets.read_frame(source.stream, frame)
        # Which rows of a large cloud are drawn is chance as well, and depends on their order.
        cloud = order.permutation(cloud)
        start = time.perf_counter()
        state = jax.block_until_ready(hio.update(state, cloud, pose))
        times_ms.append(1e3 * (time.perf_counter() - start))
        is_last = frame == mapped[-1]
        is_due = (frame + 1) % every == 0
        ends_early = source.truth is not None and frame + 1 == EARLY_FRAMES and not is_last
        if not (is_last or is_due or ends_early):
            continue
        field = as_field(state)
        assert isinstance(field, Field)
        for name, variant in variants.items():
            ask = _asking(name, field)
            if source.truth is None:
                scores = _score_held_out(field, ask, held_out_world)
            else:
                scores = metrics.evaluate(ask, source.truth, pose[:3, 3], frame)
                if name == "served":
                    scores |= metrics.evaluate_lower(
                        lambda points: _lower(field, points),  # noqa: B023 - called at once
                        source.truth,
                        frame,
                    )
            if ends_early:
                early[name] = scores["visible_cm"]
            if is_due or is_last:
                variant["over_time"].append({"frame": frame} | scores)
            if is_last:
                variant["scores"] = scores
            if is_last and source.truth is not None:
                truth = source.truth
                variant["bands"] = metrics.evaluate_bands(ask, truth, pose[:3, 3], frame)
                if name in early:
                    first = metrics.evaluate(ask, truth, last_frame=EARLY_FRAMES - 1)
                    scores["early_then_cm"] = early[name]
                    scores["early_now_cm"] = first["visible_cm"]
    return {
        "stream": source.name,
        "config_name": config_name,
        "overrides": overrides,
        "seed": seed,
        "frames": count,
        "config": dataclasses.asdict(config),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "compile_and_first_update_ms": times_ms[0],
        "update_ms": _spread(times_ms[1:]),
        "variants": variants,
    }


def _grid_sdf_and_grad(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    return lookup.grid_sdf_and_grad(field.config, field.surface, points_world)


# The map is an argument, so that each compiles once for all maps of one configuration.
VARIANTS: dict[str, Callable[..., tuple[jax.Array, jax.Array]]] = {
    "grid": jax.jit(_grid_sdf_and_grad),
    "network": jax.jit(blend.network_sdf_and_grad),
    "served": jax.jit(hio.sdf_and_grad),
}
_lower = jax.jit(lambda field, points: hio.query(field, points).lower)
_observed = jax.jit(lambda field, points: hio.query(field, points).observed)


def _asking(name: str, field: Field) -> Callable[[np.ndarray], tuple[Any, Any]]:
    return lambda points: VARIANTS[name](field, points)


def _returns_of(stream: datasets.Stream, frames: range, config: hio.Config) -> np.ndarray:
    """Returns of the held-out frames, (n, 3) m, world."""
    rng = np.random.default_rng(_HELD_OUT_SEED)
    parts = [np.empty((0, 3), np.float32)]
    for frame in frames:
        cloud, pose = datasets.read_frame(stream, frame)
        parts.append(run.draw_returns(cloud, pose, config, len(frames), rng))
    return np.concatenate(parts)


def _score_held_out(
    field: Field, ask: Callable[[np.ndarray], tuple[Any, Any]], points_world: np.ndarray
) -> dict[str, float]:
    """Scores a map on returns of other frames, earlier and later, where it has seen the place."""
    if not len(points_world):  # the stream is too short to hold frames out
        return {}
    seen = points_world[np.asarray(_observed(field, points_world))]
    return metrics.held_out_surface(lambda points: ask(points)[0], seen) if len(seen) else {}


def _with_thin_parts(
    mesh: Path, stream: datasets.Stream, truth: metrics.GroundTruth, max_range: float
) -> metrics.GroundTruth:
    from hiosdf_jax._src.scoring import visible

    try:
        rays = visible.read_rays(stream, max_range)
        scene = visible.read_scene(mesh, visible.sensor_path(rays))
    except (FileNotFoundError, ModuleNotFoundError) as error:
        print(f"thin parts are not scored: {error}")
        return truth
    drawn = visible.sample_visible(scene, rays, count=len(stream))
    return truth._replace(thin_points_world=drawn.thin_points_world)


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    names = {"median": 50, "p10": 10, "p90": 90}
    return {name: float(np.percentile(values, percent)) for name, percent in names.items()}
