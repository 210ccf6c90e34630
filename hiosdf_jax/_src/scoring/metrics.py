"""Scores of a map against exact distances, or against returns that it was not given.

Everything here runs on the host and queries the map through a callable. The same code therefore
scores a map, a baked field, a plain grid or another method.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.numerics.chunks import fill_in_chunks

# One batch shape for every call: a jitted map compiles once. Small enough that the activations of
# a wide network stay in tens of megabytes on a CPU, large enough to keep a GPU busy.
_CHUNK = 8192
_NEAR = 0.5  # m, "near" in near_cm and near_bias_cm
_LOCAL_RADIUS = 3.0  # m, the paper's local SDF error
_RADIUS_BOUNDS = (0.05, 0.4)  # m, robot spheres from a gripper finger to a mobile base
KEPT = 0.02  # m, a thin part is lost where the sdf on it exceeds this
_BANDS = {  # true distance, m: from (inclusive), to (exclusive)
    "0-5 cm": (0.0, 0.05),
    "5-20 cm": (0.05, 0.2),
    "20-50 cm": (0.2, 0.5),
    ">50 cm": (0.5, np.inf),
}


class Metric(NamedTuple):
    """The meaning of a score.

    Attributes:
        label: In words.
        unit: "cm", "ppm", or "-" for none.
        better: "lower", "higher" or "nearer 0".
    """

    label: str
    unit: str
    better: str


_METRICS = {
    "visible_cm": ("error, visible region", "cm", "lower"),
    "near_cm": ("error within 0.5 m of a surface", "cm", "lower"),
    "within_3m_cm": ("error within 3 m of the sensor", "cm", "lower"),
    "bias_cm": ("bias, map - truth", "cm", "nearer 0"),
    "near_bias_cm": ("bias within 0.5 m of a surface", "cm", "nearer 0"),
    "surface_cm": ("|sdf| on the surface", "cm", "lower"),
    "median_cm": ("|sdf| on held-out returns, median", "cm", "lower"),
    "mean_cm": ("|sdf| on held-out returns, mean", "cm", "lower"),
    "p90_cm": ("|sdf| on held-out returns, 90 % below", "cm", "lower"),
    "eikonal": ("||grad| - 1|", "-", "lower"),
    "cosine": ("1 - cos(grad, true grad)", "-", "lower"),
    "recall": ("collisions found", "-", "higher"),
    "fpr": ("free spheres called colliding", "-", "lower"),
    "thin_share": ("thin parts kept within 2 cm", "-", "higher"),
    "lower_coverage": ("lower bounds that hold", "-", "higher"),
    "lower_slack_cm": ("truth above its lower bound, mean", "cm", "lower"),
    "mesh_accuracy_cm": ("points on the mesh to the surface", "cm", "lower"),
    "mesh_completeness_cm": ("surface to the mesh", "cm", "lower"),
    "mesh_f_1cm": ("F-score of the mesh at 1 cm", "-", "higher"),
    "mesh_f_2cm": ("F-score of the mesh at 2 cm", "-", "higher"),
    "mesh_f_5cm": ("F-score of the mesh at 5 cm", "-", "higher"),
    "mesh_sdf_cm": ("error of the distance to the mesh", "cm", "lower"),
    "mesh_thin_share": ("thin parts within 2 cm of the mesh", "-", "higher"),
    "mesh_median_cm": ("held-out returns to the mesh, median", "cm", "lower"),
    "mesh_p90_cm": ("held-out returns to the mesh, 90 % below", "cm", "lower"),
    "steps_ppm": ("changes > 5 mm along 2.5 mm", "ppm", "lower"),
    "step_largest_cm": ("largest change along 2.5 mm", "cm", "lower"),
    "far_flips_ppm": ("sign changes far from the mesh", "ppm", "lower"),
    "early_then_cm": ("error where the first frames saw, after them", "cm", "lower"),
    "early_now_cm": ("error where the first frames saw, at the end", "cm", "lower"),
}
METRICS = {key: Metric(*meaning) for key, meaning in _METRICS.items()}


class _Answers(NamedTuple):
    """The answers of a map beside the truth, at the selected points."""

    points_world: np.ndarray
    sdf_true: np.ndarray
    sdf_map: np.ndarray
    eikonal: np.ndarray  # | |grad| - 1 |
    cosine: np.ndarray  # 1 - cos(grad, true grad)
    radius: np.ndarray  # m, of the sphere centered on the point
    complete: bool  # no frame is left out


def evaluate(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]],
    truth: GroundTruth,
    sensor_position_world: Any | None = None,
    last_frame: int | None = None,
) -> dict[str, float]:
    """Scores a map against exact distances (section V-B of the paper, and collision recall).

    Nothing is left out of a mean: a map that returns NaN gets NaN scores. A score with nothing to
    average, such as recall without a true collision, is NaN too.

    Example:
        field = hio.snapshot(state)
        truth = datasets.read_truth("house_depth.npz")
        scores = scoring.evaluate(lambda points: hio.sdf_and_grad(field, points), truth)
        print(scoring.format_table(scores))

    Args:
        sdf_and_grad: Maps (n, 3) float32 points, m, world frame, to (n,) distances, m, and (n, 3)
            gradients, as numpy or jax arrays. Every call has the same n.
        truth: Exact distances; see `GroundTruth`.
        sensor_position_world: (3,) m; adds `within_3m_cm`, the paper's local SDF error.
        last_frame: Use only points that were first observed in frames <= last_frame. Surface points
            carry no frame, so `surface_cm` is NaN if this leaves points out.

    Returns:
        `visible_cm`: mean absolute error.
        `near_cm`: the same where the true distance is < 0.5 m.
        `within_3m_cm`: the same within 3 m of the sensor, if `sensor_position_world` is given.
        `bias_cm`: mean of map - truth.
        `near_bias_cm`: the same where the true distance is < 0.5 m.
        `surface_cm`: mean |sdf| on surface points.
        `eikonal`: mean of | |grad| - 1 |.
        `cosine`: mean of 1 - cos(grad, true grad); 1 where a gradient is zero.
        `recall`, `fpr`: recall and false-alarm rate of the test "a sphere collides if the distance
            at its center < its radius". The spheres are centered on the points, with radii of 0.05
            to 0.4 m from a fixed seed.
        `thin_share`: share of the points on thin parts where sdf <= 2 cm, if truth has such points
            and no point is left out.

    Raises:
        ValueError: Truth is misshapen, no point has frame <= last_frame, the sensor position is not
            (3,), or the map returned the wrong shape.
    """
    answers = _ask(sdf_and_grad, truth, last_frame)
    error = answers.sdf_map - answers.sdf_true
    near = answers.sdf_true < _NEAR
    everywhere = np.full(len(error), True)
    paper = _paper_metrics(answers, everywhere, sensor_position_world)
    collides = answers.sdf_true < answers.radius
    called = np.where(np.isnan(answers.sdf_map), np.nan, answers.sdf_map < answers.radius)
    scores = paper | {
        "near_cm": 100 * _mean(np.abs(error[near])),
        "bias_cm": 100 * _mean(error),
        "near_bias_cm": 100 * _mean(error[near]),
        "recall": _mean(called[collides]),
        "fpr": _mean(called[~collides]),
        "surface_cm": np.nan,  # surface points carry no frame
    }
    if answers.complete:
        surface = in_chunks(lambda p: sdf_and_grad(p)[0], truth.surface_points_world)
        scores["surface_cm"] = 100 * _mean(np.abs(surface))
    if answers.complete and len(truth.thin_points_world):
        thin = in_chunks(lambda p: sdf_and_grad(p)[0], truth.thin_points_world)
        scores["thin_share"] = _mean(np.where(np.isnan(thin), np.nan, thin <= KEPT))
    return {key: scores[key] for key in METRICS if key in scores}


def explain_missing(truth: GroundTruth, last_frame: int | None) -> dict[str, str]:
    """Says why scores of `evaluate` have no value.

    Args:
        truth: As in `evaluate`.
        last_frame: As in `evaluate`.

    Returns:
        {metric: reason}, for the metrics that these frames leave without a value.
    """
    if last_frame is None or (np.asarray(truth.frame) <= last_frame).all():
        return {}
    reason = "it is scored once all frames are mapped: its points carry no frame"
    names = ["surface_cm", *(["thin_share"] if len(truth.thin_points_world) else [])]
    return dict.fromkeys(names, reason)


def evaluate_bands(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]],
    truth: GroundTruth,
    sensor_position_world: Any | None = None,
    last_frame: int | None = None,
) -> dict[str, dict[str, float]]:
    """Scores a map by the paper's four metrics, separately for bands of the true distance.

    Args:
        sdf_and_grad: As in `evaluate`.
        truth: As in `evaluate`.
        sensor_position_world: As in `evaluate`.
        last_frame: As in `evaluate`.

    Returns:
        {band: scores}. The bands are "0-5 cm", "5-20 cm", "20-50 cm" and ">50 cm" of true distance;
        each includes its lower end. The scores are `visible_cm`, `within_3m_cm` (only with
        `sensor_position_world`), `eikonal` and `cosine`, as in `evaluate`.

    Raises:
        ValueError: As in `evaluate`.

    Example:
        bands = scoring.evaluate_bands(lambda points: hio.sdf_and_grad(field, points), truth)
        print(scoring.format_bands(bands))
    """
    answers = _ask(sdf_and_grad, truth, last_frame)
    distance = np.abs(answers.sdf_true)
    return {
        band: _paper_metrics(answers, (low <= distance) & (distance < high), sensor_position_world)
        for band, (low, high) in _BANDS.items()
    }


def evaluate_lower(
    lower: Callable[[np.ndarray], Any], truth: GroundTruth, last_frame: int | None = None
) -> dict[str, float]:
    """Scores a map's lower bounds of the distance.

    Args:
        lower: Maps (n, 3) float32 points, m, world frame, to (n,) bounds, m. Every call has the
            same n.
        truth: Exact distances.
        last_frame: Use only points that were first observed in frames <= last_frame.

    Returns:
        `lower_coverage`: share of the points where the bound does not exceed the true distance.
        `lower_slack_cm`: mean of true distance - bound.

    Example:
        scores = scoring.evaluate_lower(lambda points: hio.query(field, points).lower, truth)
    """
    selected = np.full(len(truth.sdf), True) if last_frame is None else truth.frame <= last_frame
    slack = truth.sdf[selected].astype(float) - in_chunks(lower, truth.points_world[selected])
    return {"lower_coverage": _mean(slack >= 0), "lower_slack_cm": 100 * _mean(slack)}


def held_out_surface(
    sdf: Callable[[np.ndarray], Any], points_world: np.ndarray
) -> dict[str, float]:
    """Scores a map of a real stream on returns that it was not given.

    Apart from the noise of the sensor the distance at a return is zero, so this needs no ground
    truth.

    Args:
        sdf: Maps (n, 3) float32 points, m, world frame, to (n,) distances, m. Every call has the
            same n.
        points_world: (N, 3) m, returns of frames that the map was not given.

    Returns:
        `median_cm`, `mean_cm` and `p90_cm` (90th percentile) of |sdf|.

    Raises:
        ValueError: points_world is not (N, 3) with N > 0, or the map returned the wrong shape.

    Example:
        scores = scoring.held_out_surface(lambda points: hio.sdf(field, points), returns_world)
        print(scores["median_cm"])
    """
    points = np.asarray(points_world)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"points_world has shape {points.shape}, expected (N, 3) with N > 0")
    error_cm = 100 * np.abs(in_chunks(sdf, points))
    return {
        "median_cm": float(np.median(error_cm)),
        "mean_cm": _mean(error_cm),
        "p90_cm": float(np.percentile(error_cm, 90)),
    }


def _ask(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]],
    truth: GroundTruth,
    last_frame: int | None,
) -> _Answers:
    """Queries a map at the points of truth up to a frame."""
    points, sdf_true, grad_true, frame, surface, thin = (np.asarray(field) for field in truth)
    count = len(points)
    for name, array, shape in (
        ("points_world", points, (count, 3)),
        ("sdf", sdf_true, (count,)),
        ("grad", grad_true, (count, 3)),
        ("frame", frame, (count,)),
        ("surface_points_world", surface, (len(surface), 3)),
        ("thin_points_world", thin, (len(thin), 3)),
    ):
        if array.shape != shape:
            raise ValueError(f"truth.{name} has shape {array.shape}, expected {shape}")

    # Drawn for all points before any are dropped, so that a point keeps its sphere.
    radius = np.random.default_rng(1).uniform(*_RADIUS_BOUNDS, count)
    selected = np.full(count, True) if last_frame is None else frame <= last_frame
    if not selected.any():
        raise ValueError(
            f"last_frame = {last_frame} leaves none of the {count} points of truth; "
            f"expected last_frame >= {frame.min() if count else 0} and a truth with points"
        )
    points, grad_true = points[selected], grad_true[selected].astype(float)
    sdf_map, grad_map = np.empty(len(points)), np.empty((len(points), 3))
    fill_in_chunks(
        lambda rows: sdf_and_grad(points[rows].astype(np.float32)),
        {"sdf of the map": sdf_map, "grad of the map": grad_map},
        _CHUNK,
    )
    norm_map = np.linalg.norm(grad_map, axis=-1)
    norm_product = norm_map * np.linalg.norm(grad_true, axis=-1)
    cosine = np.sum(grad_map * grad_true, axis=-1) / np.where(norm_product == 0, 1, norm_product)
    return _Answers(
        points_world=points,
        sdf_true=sdf_true[selected].astype(float),
        sdf_map=sdf_map,
        eikonal=np.abs(norm_map - 1),
        cosine=1 - cosine,
        radius=radius[selected],
        complete=bool(selected.all()),
    )


def _paper_metrics(
    answers: _Answers, chosen: np.ndarray, sensor_position_world: Any | None
) -> dict[str, float]:
    """The four metrics of the paper's section V-B over the chosen points, (n,) bool."""
    error = np.abs(answers.sdf_map - answers.sdf_true)
    scores = {
        "visible_cm": 100 * _mean(error[chosen]),
        "eikonal": _mean(answers.eikonal[chosen]),
        "cosine": _mean(answers.cosine[chosen]),
    }
    if sensor_position_world is not None:
        sensor = np.asarray(sensor_position_world, float)
        if sensor.shape != (3,):
            raise ValueError(f"sensor_position_world has shape {sensor.shape}, expected (3,)")
        local = np.linalg.norm(answers.points_world - sensor, axis=-1) < _LOCAL_RADIUS
        scores["within_3m_cm"] = 100 * _mean(error[chosen & local])
    return scores


def in_chunks(
    function: Callable[[np.ndarray], Any], points: np.ndarray, kind: type = float
) -> np.ndarray:
    """Evaluates a function of points, (N, 3) -> (N,) of a kind, in chunks of one shape."""
    values = np.empty(len(points), kind)
    fill_in_chunks(
        lambda rows: (function(points[rows].astype(np.float32)),),
        {"sdf of the map": values},
        _CHUNK,
    )
    return values


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
