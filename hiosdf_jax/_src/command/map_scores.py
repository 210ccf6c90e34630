"""The scores of a saved map: `hiosdf eval`."""

from __future__ import annotations

import os
from typing import Any

from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.mapping import checkpoint
from hiosdf_jax._src.mapping.lifecycle import snapshot
from hiosdf_jax._src.scoring import metrics
from hiosdf_jax._src.state.pytrees import MapState


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
    queries = CompiledQueries(snapshot(state))
    scores = metrics.evaluate(queries.sdf_and_grad, truth, None, last_frame)
    scores |= metrics.evaluate_lower(queries.lower, truth, last_frame)
    bands = metrics.evaluate_bands(queries.sdf_and_grad, truth, None, last_frame)
    missing = metrics.explain_missing(truth, last_frame)
    return {"scores": scores, "bands": bands} | ({"not_scored": missing} if missing else {})
