"""Maps a stream, and scores the map along the way and at the end.

Each score has three variants: the grid alone, the network alone, and both blended.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.accuracy.sources import Source
from benchmarks.variants import VARIANTS
from hiosdf_jax import datasets, scoring
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.field.patch_rectangles import as_rectangles, find_patches
from hiosdf_jax._src.state.pytrees import Field, field_of

if TYPE_CHECKING:
    import trimesh

# Forgetting compares the error in the region of the first frames, right after them and at the end.
EARLY_FRAMES = 20

_HELD_OUT_SEED = 0


def measure_source(
    source: Source, config_name: str, seed: int, every: int, overrides: dict[str, Any]
) -> dict[str, Any]:
    """Maps a stream and scores the map.

    Args:
        source: The stream.
        config_name: "light", "paper" or "default".
        seed: Seed of the map's randomness and of the order of the clouds' rows.
        every: Number of frames between two scores; the last frame is always scored.
        overrides: Fields of the configuration to change.

    Returns:
        A run for JSON with its identity, its times and `variants`. Each of grid, network and
        blended has `scores`, `bands` (scores by band of true distance) and `over_time`.
    """
    config = getattr(hio.Config, config_name)(
        source.extent.bounds, **({"max_range": source.extent.max_range} | overrides)
    )
    count, truth = len(source.stream), source.truth
    held_out = scoring.held_out_frames(count) if truth is None else range(0)
    held_out_world = draw_held_out(source.stream, config) if held_out else np.empty((0, 3))
    mapped = [frame for frame in range(count) if frame not in held_out]
    last = mapped[-1]
    state = hio.init(config, jax.random.key(seed))
    order = np.random.default_rng(seed)
    times_ms, early = [], {}
    variants = {name: {"scores": {}, "bands": {}, "over_time": []} for name in VARIANTS}
    for frame in tqdm(mapped, desc=f"{source.name} {config_name} seed {seed}", unit="frame"):
        cloud, pose = datasets.read_frame(source.stream, frame)
        # The rows that are drawn from a large cloud are random too, and depend on their order.
        cloud = order.permutation(cloud)
        start = time.perf_counter()
        state = jax.block_until_ready(hio.update(state, cloud, pose))
        times_ms.append(1e3 * (time.perf_counter() - start))
        is_due = (frame + 1) % every == 0 or frame == last
        ends_early = truth is not None and frame + 1 == EARLY_FRAMES and frame != last
        if not (is_due or ends_early):
            continue
        field = field_of(state)
        for name, variant in variants.items():
            if truth is None:
                scores = _score_held_out(name, field, held_out_world)
            else:
                scores = _score(name, field, truth, pose, frame)
            if ends_early:
                early[name] = scores["visible_cm"]
            if is_due:
                variant["over_time"].append({"frame": frame} | scores)
            if frame == last:
                variant["scores"] = scores
            if frame == last and name == "blended":
                scores |= _score_surface(field, source, held_out_world)
            if frame == last and truth is not None:
                query = _query_of(name, field)
                variant["bands"] = scoring.evaluate_bands(query, truth, pose[:3, 3], frame)
                if name in early:
                    first = scoring.evaluate(query, truth, last_frame=EARLY_FRAMES - 1)
                    scores["early_then_cm"] = early[name]
                    scores["early_now_cm"] = first["visible_cm"]
    return {
        "stream": source.name,
        "config_name": config_name,
        "overrides": overrides,
        "seed": seed,
        "frames": count,
        "config": dataclasses.asdict(config),
        "compile_and_first_update_ms": times_ms[0],
        "update_ms": records.percentiles(times_ms[1:]),
        "variants": variants,
    } | records.provenance()


def _query_of(name: str, field: Field) -> Callable[[np.ndarray], tuple[Any, Any]]:
    return lambda points: VARIANTS[name](field, points)


def _score(
    name: str, field: Field, truth: scoring.GroundTruth, pose: np.ndarray, frame: int
) -> dict[str, float]:
    """Scores a map against the truth that was seen up to a frame."""
    scores = scoring.evaluate(_query_of(name, field), truth, pose[:3, 3], frame)
    if name == "blended":
        scores |= scoring.evaluate_lower(CompiledQueries(field).lower, truth, frame)
    return scores


def _score_surface(field: Field, source: Source, held_out_world: np.ndarray) -> dict[str, float]:
    """Scores a map's mesh and the steps of its distance; nothing without the libraries for it."""
    try:
        mesh = hio.extract_mesh(field)
        if source.truth is None:
            return scoring.evaluate_held_out_mesh(mesh, held_out_world)
        scores = scoring.evaluate_mesh(mesh, source.truth, source.distance)
        queries, config = CompiledQueries(field), field.config
        return scores | scoring.evaluate_steps(
            queries.sdf, queries.observed, config.bounds, _patches_of(field), config.voxel_size
        )
    except ModuleNotFoundError as error:
        print(f"the mesh is not scored: {error}")
        return {}


def _patches_of(field: Field) -> trimesh.Trimesh:
    """Returns all surface patches as a mesh; `extract_mesh` leaves out those inside walls."""
    import trimesh

    config = field.config
    found = as_rectangles(find_patches(field.surface))
    vertices_world = (found.vertex + config.corner_index) * config.voxel_size
    return trimesh.Trimesh(vertices_world, found.face, process=False)


def _score_held_out(name: str, field: Field, points_world: np.ndarray) -> dict[str, float]:
    """Scores a map on returns of held-out frames, earlier and later, in observed space."""
    query, observed = _query_of(name, field), CompiledQueries(field).observed
    scores = scoring.score_held_out(lambda points: query(points)[0], observed, points_world)
    return {key: value for key, value in scores.items() if key in scoring.METRICS}


def draw_held_out(stream: datasets.Stream, config: hio.Config) -> np.ndarray:
    """Draws returns of the held-out frames, (n, 3) m, world frame."""
    rng, frames = np.random.default_rng(_HELD_OUT_SEED), scoring.held_out_frames(len(stream))
    parts = [np.empty((0, 3), np.float32)]
    for frame in frames:
        cloud, pose = datasets.read_frame(stream, frame)
        parts.append(scoring.draw_returns(cloud, pose, config, len(frames), rng))
    return np.concatenate(parts)
