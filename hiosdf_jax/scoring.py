"""Scores of a map against exact distances, and against returns that it was not given.

    from hiosdf_jax import datasets, scoring

    truth = datasets.read_truth("house_depth.npz")
    field = hio.snapshot(state)
    scores = scoring.evaluate(lambda points: hio.sdf_and_grad(field, points), truth)
    print(scoring.format_table(scores))

`read_rays`, `read_scene` and `sample_visible` make such a truth from a stream and a mesh of its
scene.
"""

from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.scoring.held_out import draw_returns, held_out_frames, score_held_out
from hiosdf_jax._src.scoring.metrics import (
    METRICS,
    Metric,
    evaluate,
    evaluate_bands,
    evaluate_lower,
    held_out_surface,
)
from hiosdf_jax._src.scoring.rows import write_csv
from hiosdf_jax._src.scoring.scene import Scene, mesh_scene, read_scene
from hiosdf_jax._src.scoring.surface import (
    evaluate_held_out_mesh,
    evaluate_mesh,
    evaluate_steps,
)
from hiosdf_jax._src.scoring.table import format_bands, format_score, format_table, lay_out
from hiosdf_jax._src.scoring.visible import StreamRays, read_rays, sample_visible, sensor_path

__all__ = [
    "METRICS",
    "GroundTruth",
    "Metric",
    "Scene",
    "StreamRays",
    "draw_returns",
    "evaluate",
    "evaluate_bands",
    "evaluate_held_out_mesh",
    "evaluate_lower",
    "evaluate_mesh",
    "evaluate_steps",
    "format_bands",
    "format_score",
    "format_table",
    "held_out_frames",
    "held_out_surface",
    "lay_out",
    "mesh_scene",
    "read_rays",
    "read_scene",
    "sample_visible",
    "score_held_out",
    "sensor_path",
    "write_csv",
]
