"""The scores of a saved map: `hiosdf eval`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.mapping import checkpoint
from hiosdf_jax._src.mapping.lifecycle import snapshot
from hiosdf_jax._src.scoring import metrics
from hiosdf_jax._src.state.pytrees import MapState

if TYPE_CHECKING:
    import numpy as np


def score_map(
    path: str | os.PathLike[str], state: MapState, truth: GroundTruth
) -> dict[str, dict[str, Any]]:
    """Scores a map that was read from a file, where its stream had observed the scene by then.

    Args:
        path: The file; if the command has written it, it says how far the stream was read.
        state: The map in it.
        truth: Exact distances.

    Returns:
        `scores` and `bands`, and `not_scored` if a score has no value, as in `metrics.json`.

    Raises:
        ValueError: The map had not come to any of the exact distances.
    """
    notes = checkpoint.read_progress(path)
    last_frame = None
    if isinstance(notes, dict) and isinstance(notes.get("next_frame"), int):
        last_frame = notes["next_frame"] - 1
        if not (truth.frame <= last_frame).any():
            raise ValueError(f"{os.fspath(path)}: no exact distance belongs to its frames")
    return scores_of(CompiledQueries(snapshot(state)), truth, None, last_frame)


def scores_of(
    queries: CompiledQueries,
    truth: GroundTruth,
    sensor_world: np.ndarray | None,
    last_frame: int | None,
) -> dict[str, dict[str, Any]]:
    """Scores a map against exact distances.

    Args:
        queries: The queries of the map.
        truth: Exact distances.
        sensor_world: (3,) m, the position of the sensor, if it is known.
        last_frame: The last frame of the stream that was mapped; None for all of them.

    Returns:
        `scores` and `bands`, and `not_scored` if a score has no value, as in `metrics.json`.
    """
    scores = metrics.evaluate(queries.sdf_and_grad, truth, sensor_world, last_frame)
    scores |= metrics.evaluate_lower(queries.lower, truth, last_frame)
    bands = metrics.evaluate_bands(queries.sdf_and_grad, truth, sensor_world, last_frame)
    missing = metrics.explain_missing(truth, last_frame)
    return {"scores": scores, "bands": bands} | ({"not_scored": missing} if missing else {})
