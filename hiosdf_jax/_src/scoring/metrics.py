"""Scores of a map against exact distances, and of any map against a table of peers.

Everything here runs on the host and asks the map only through a callable, so that the same code
scores our map, a baked field, a plain grid or somebody else's method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

# One batch shape for every call: a jitted map compiles once. Small enough that the activations of
# a wide network stay in tens of megabytes on a CPU, large enough to keep a GPU busy.
_CHUNK = 8192
_NEAR = 0.5  # m, "near" in near_cm and near_bias_cm
_LOCAL_RADIUS = 3.0  # m, the paper's local SDF error
_RADIUS_BOUNDS = (0.05, 0.4)  # m, robot spheres from a gripper's finger to a mobile base
_KEPT = 0.02  # m, a point of a thin part whose sdf is more than this has been lost
_THIN_RETURNS = 10  # that a thin part needs to count
_THIN_POINTS = 50  # at most so many points of each part, so that a leg counts as much as a shelf
_BANDS = {  # of the true distance, m: least (in the band), upper end (not in it)
    "0-5 cm": (0.0, 0.05),
    "5-20 cm": (0.05, 0.2),
    "20-50 cm": (0.2, 0.5),
    ">50 cm": (0.5, np.inf),
}


class Metric(NamedTuple):
    """What a score means.

    Attributes:
        label: In words.
        unit: "cm", or "-" for none.
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
    "early_then_cm": ("error where the first frames saw, after them", "cm", "lower"),
    "early_now_cm": ("error where the first frames saw, at the end", "cm", "lower"),
}
METRICS = {key: Metric(*meaning) for key, meaning in _METRICS.items()}


class GroundTruth(NamedTuple):
    """Exact distances of a scene, at points that a sensor saw to be free.

    Attributes:
        points_world: (N, 3) float32, metres; points on rays between the sensor and the surface.
        sdf: (N,) float32, metres; exact distance to the nearest surface.
        grad: (N, 3) float32; exact unit gradient of the distance, d(sdf)/d(point).
        frame: (N,) int32; the frame in which the point was first sampled.
        surface_points_world: (M, 3) float32, metres; exact surface points that the sensor saw.
        thin_points_world: (K, 3) float32, metres; exact surface points that the sensor saw of parts
            less than 5 cm thick; empty where nobody has told such parts from others.
    """

    points_world: np.ndarray
    sdf: np.ndarray
    grad: np.ndarray
    frame: np.ndarray
    surface_points_world: np.ndarray
    thin_points_world: np.ndarray = np.empty((0, 3), np.float32)


class _Answers(NamedTuple):
    """A map's answers beside the truth, at the points that count."""

    points_world: np.ndarray
    sdf_true: np.ndarray
    sdf_map: np.ndarray
    eikonal: np.ndarray  # | |grad| - 1 |
    cosine: np.ndarray  # 1 - cos(grad, true grad)
    radius: np.ndarray  # m, of the sphere that stands at the point
    complete: bool  # no frame is left out


def evaluate(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]],
    truth: GroundTruth,
    sensor_position_world: Any | None = None,
    last_frame: int | None = None,
) -> dict[str, float]:
    """Scores a map against exact distances (section V-B of the paper, and collision recall).

    A map that answers NaN gets NaN scores: nothing is left out of a mean. A score with nothing to
    average (no true collision, say) is NaN too.

    Args:
        sdf_and_grad: Maps (n, 3) float32 points in the world, metres, to (n,) distances in metres
            and (n, 3) gradients, as numpy or jax arrays. Always called with the same n.
        truth: Exact distances; see `GroundTruth`.
        sensor_position_world: (3,) metres; adds `within_3m_cm`, the paper's local SDF error.
        last_frame: Only points first seen in frames <= last_frame count. Surface points carry no
            frame, so `surface_cm` is NaN while later frames are left out.

    Returns:
        `visible_cm` mean absolute error; `near_cm` the same where the true distance is < 0.5 m;
        `within_3m_cm` the same within 3 m of the sensor (only with `sensor_position_world`);
        `bias_cm` mean of map - truth; `near_bias_cm` the same where the true distance is < 0.5 m;
        `surface_cm` mean |sdf| on surface points; `eikonal` mean of
        | |grad| - 1 |; `cosine` mean of 1 - cos(grad, true grad), 1 where a gradient is zero;
        `recall` and `fpr` of "a sphere collides when the distance at its centre < its radius",
        for spheres of 0.05 to 0.4 m radius (drawn from one fixed seed) centred on the points;
        `thin_share` share of the points on thin parts where sdf <= 2 cm (only if truth has such
        points and no frame is left out).

    Raises:
        ValueError: Truth is misshapen, no point has frame <= last_frame, the sensor position is not
            (3,), or the map's answers have the wrong shape.
    """
    answers = _ask(sdf_and_grad, truth, last_frame)
    error = answers.sdf_map - answers.sdf_true
    near = answers.sdf_true < _NEAR
    everywhere = np.full(len(error), True)
    paper = _paper_metrics(answers, everywhere, sensor_position_world)
    collides = answers.sdf_true < answers.radius
    called = np.where(np.isnan(answers.sdf_map), np.nan, answers.sdf_map < answers.radius)
    # Points on surfaces carry no frame.
    surface = truth.surface_points_world if answers.complete else np.empty((0, 3))
    scores = paper | {
        "near_cm": 100 * _mean(np.abs(error[near])),
        "bias_cm": 100 * _mean(error),
        "near_bias_cm": 100 * _mean(error[near]),
        "surface_cm": 100 * _mean(np.abs(_in_chunks(sdf_and_grad, surface)[0])),
        "recall": _mean(called[collides]),
        "fpr": _mean(called[~collides]),
    }
    if answers.complete and len(truth.thin_points_world):
        thin = _in_chunks(sdf_and_grad, truth.thin_points_world)[0]
        scores["thin_share"] = _mean(np.where(np.isnan(thin), np.nan, thin <= _KEPT))
    return {key: scores[key] for key in METRICS if key in scores}


def evaluate_bands(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]],
    truth: GroundTruth,
    sensor_position_world: Any | None = None,
    last_frame: int | None = None,
) -> dict[str, dict[str, float]]:
    """Scores a map by the paper's four metrics, near surfaces and far from them apart.

    Args:
        sdf_and_grad: As for `evaluate`.
        truth: As for `evaluate`.
        sensor_position_world: As for `evaluate`.
        last_frame: As for `evaluate`.

    Returns:
        {band: scores}; the bands are of the true distance, "0-5 cm", "5-20 cm", "20-50 cm" and
        ">50 cm" (the nearer end belongs to a band); the scores are `visible_cm`, `within_3m_cm`
        (only with `sensor_position_world`), `eikonal` and `cosine`, as of `evaluate`.

    Raises:
        ValueError: As of `evaluate`.
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
    """Scores the lower bounds of the distance that a map gives.

    Args:
        lower: Maps (n, 3) float32 points in the world, metres, to (n,) bounds in metres. Always
            called with the same n.
        truth: Exact distances at points that the sensor saw.
        last_frame: Only points that were first sampled up to this frame count; None for all.

    Returns:
        `lower_coverage`, the share of the points at which the true distance is not below the
        bound; `lower_slack_cm`, the mean of what lies between them.
    """
    selected = np.full(len(truth.sdf), True) if last_frame is None else truth.frame <= last_frame
    bound, _ = _in_chunks(lambda points: (lower(points), points), truth.points_world[selected])
    slack = truth.sdf[selected].astype(float) - bound
    return {"lower_coverage": _mean(slack >= 0), "lower_slack_cm": 100 * _mean(slack)}


def held_out_surface(
    sdf: Callable[[np.ndarray], Any], points_world: np.ndarray
) -> dict[str, float]:
    """Scores a map of a real stream on returns that it was not given.

    The distance at a return is zero but for the sensor's noise, so that this needs no ground truth.

    Args:
        sdf: Maps (n, 3) float32 points in the world, metres, to (n,) distances in metres. Always
            called with the same n.
        points_world: (N, 3) metres, returns of frames that the map has not seen.

    Returns:
        `median_cm`, `mean_cm` and `p90_cm` (90th percentile) of |sdf| in centimetres.

    Raises:
        ValueError: points_world is not (N, 3) with N > 0, or the map's answers are misshapen.
    """
    points = np.asarray(points_world)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"points_world has shape {points.shape}, expected (N, 3) with N > 0")
    error_cm = 100 * np.abs(_in_chunks(lambda p: (sdf(p), p), points)[0])
    return {
        "median_cm": float(np.median(error_cm)),
        "mean_cm": _mean(error_cm),
        "p90_cm": float(np.percentile(error_cm, 90)),
    }


def choose_thin(part: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Chooses among returns those that tell whether thin parts are in a map.

    Args:
        part: (R,) int, number of the thin part that each return is from; -1 for anything else.
        rng: Source of randomness.

    Returns:
        (K,) indices of returns: up to 50 of each part that has at least 10.
    """
    order = np.argsort(part, kind="stable")
    order = order[part[order] >= 0]
    _, starts = np.unique(part[order], return_index=True)
    chosen = [
        rng.choice(rows, min(len(rows), _THIN_POINTS), replace=False)
        for rows in np.split(order, starts[1:])
        if len(rows) >= _THIN_RETURNS
    ]
    return np.concatenate([np.empty(0, int), *chosen])


def format_table(
    scores: Mapping[str, float], peers: Mapping[str, Mapping[str, Any]] | None = None
) -> str:
    """Lays scores out as a table for a terminal.

    Args:
        scores: What `evaluate` or `held_out_surface` returned.
        peers: {name: {metric: value}}; a value may be a list (one a seed), of which the mean is
            shown. Peers with none of these metrics are left out.

    Returns:
        The table, one metric a row with its unit and which direction is better, then ours, then the
        peers. A dash stands for "no value".
    """
    rows = [key for key in METRICS if key in scores]
    columns: dict[str, Mapping[str, Any]] = {"ours": scores}
    columns |= {name: peer for name, peer in (peers or {}).items() if any(r in peer for r in rows)}
    cells = [["metric", "unit", "better", *columns]]
    for key in rows:
        cells.append(
            [*METRICS[key], *(format_score(key, each.get(key)) for each in columns.values())]
        )
    return lay_out(cells, text_columns=3)


def format_bands(bands: Mapping[str, Mapping[str, float]]) -> str:
    """Lays scores by band of the true distance out as a table for a terminal.

    Args:
        bands: What `evaluate_bands` returned.

    Returns:
        The table, one band a row, one metric a column.
    """
    keys = [key for key in METRICS if any(key in scores for scores in bands.values())]
    cells = [["true distance", *keys]]
    for band, scores in bands.items():
        cells.append([band, *(format_score(key, scores.get(key)) for key in keys)])
    return lay_out(cells, text_columns=1)


def format_score(key: str, value: Any) -> str:
    """Writes a score as in all tables.

    Args:
        key: One of `METRICS`.
        value: The score, None, or several of which the mean is taken.

    Returns:
        Two decimals of centimetres, three of anything else; a dash for no value or NaN.
    """
    if value is None or not np.isfinite(np.mean(value)):
        return "-"
    return f"{np.mean(value):.{2 if METRICS[key].unit == 'cm' else 3}f}"


def lay_out(cells: Sequence[Sequence[str]], text_columns: int) -> str:
    """Aligns a table, with a line under its first row.

    Args:
        cells: Rows of the same length, the first of them the headings.
        text_columns: The first so many columns are text, aligned left; the rest are numbers.

    Returns:
        The table, without a line break at its end.
    """
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = [
        "  ".join(
            cell.ljust(width) if i < text_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


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
    sdf_map, grad_map = _in_chunks(sdf_and_grad, points)
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


def _in_chunks(
    sdf_and_grad: Callable[[np.ndarray], tuple[Any, Any]], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Queries in chunks of one shape; returns float64 (N,) and (N, 3)."""
    sdf, grad = np.empty(len(points)), np.empty((len(points), 3))
    for start in range(0, len(points), _CHUNK):
        chunk = points[start : start + _CHUNK].astype(np.float32)
        n = len(chunk)
        # The last point repeated: a padding that every map can answer.
        values, grads = sdf_and_grad(np.pad(chunk, ((0, _CHUNK - n), (0, 0)), mode="edge"))
        for name, array, shape in (("sdf", values, (_CHUNK,)), ("grad", grads, (_CHUNK, 3))):
            if np.shape(array) != shape:
                raise ValueError(
                    f"the map answered {name} of shape {np.shape(array)} for {_CHUNK} points, "
                    f"expected {shape}"
                )
        sdf[start : start + n] = np.asarray(values)[:n]
        grad[start : start + n] = np.asarray(grads)[:n]
    return sdf, grad


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
