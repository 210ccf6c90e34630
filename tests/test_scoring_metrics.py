"""The metrics against values known in closed form and against a loop over scalars."""

import math
from pathlib import Path

import jax
import numpy as np
import pytest
from exact_sphere import CENTER, RADIUS, sphere, sphere_truth

from hiosdf_jax._src.scoring import metrics
from hiosdf_jax._src.scoring.metrics import explain_missing
from hiosdf_jax.datasets import read_truth
from hiosdf_jax.scoring import (
    GroundTruth,
    evaluate,
    evaluate_bands,
    evaluate_lower,
    held_out_surface,
)

SHARED = Path(__file__).parents[2] / "shared" / "data"


def test_an_exact_map_scores_perfectly():
    scores = evaluate(sphere, sphere_truth(), sensor_position_world=CENTER)
    keys = ("visible_cm", "near_cm", "within_3m_cm", "bias_cm", "near_bias_cm", "surface_cm")
    for key in keys:
        assert scores[key] == pytest.approx(0, abs=2e-5), key
    assert scores["eikonal"] == pytest.approx(0, abs=1e-6)
    assert scores["cosine"] == pytest.approx(0, abs=1e-6)
    assert scores["recall"] == 1
    assert scores["fpr"] == 0


def test_a_known_error_gives_known_scores():
    # 2 cm too far, and a gradient twice as long, turned by 60 degrees.
    def wrong(points):
        sdf, grad = sphere(points)
        sideways = np.cross(grad, [0.1, 0.2, 0.97])
        sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
        return sdf + 0.02, 2 * (0.5 * grad + math.sqrt(0.75) * sideways)

    scores = evaluate(wrong, sphere_truth())
    assert scores["visible_cm"] == pytest.approx(2, abs=1e-4)
    assert scores["bias_cm"] == pytest.approx(2, abs=1e-4)
    assert scores["surface_cm"] == pytest.approx(2, abs=1e-4)
    assert scores["eikonal"] == pytest.approx(1, abs=1e-5)
    assert scores["cosine"] == pytest.approx(0.5, abs=1e-5)
    assert scores["recall"] < 1
    assert scores["fpr"] == 0
    too_near = evaluate(lambda p: (sphere(p)[0] - 0.02, sphere(p)[1]), sphere_truth())
    assert too_near["bias_cm"] == pytest.approx(-2, abs=1e-4)
    assert too_near["recall"] == 1
    assert too_near["fpr"] > 0
    assert "within_3m_cm" not in scores


@pytest.mark.parametrize("last_frame", [None, 4])
def test_scores_equal_a_loop_over_scalars(last_frame):
    truth = sphere_truth()
    sensor = np.array([1.5, 0.5, 0.0])

    def noisy(points):
        sdf, grad = sphere(points)
        ripple = 0.1 * np.sin(9 * points)
        return sdf + ripple.sum(-1), grad + ripple

    scores = evaluate(noisy, truth, sensor_position_world=sensor, last_frame=last_frame)

    # The rule of peers.json: one radius per point of the file, before points are left out.
    radii = np.random.default_rng(1).uniform(0.05, 0.4, len(truth.sdf))
    error, near, near_signed, local, signed, eikonal, cosine = [], [], [], [], [], [], []
    bands = {"0-5 cm": [], "5-20 cm": [], "20-50 cm": [], ">50 cm": []}
    true, called_true, false, called_false = 0, 0, 0, 0
    for point, d, g, frame, radius in zip(*truth[:4], radii, strict=True):
        if last_frame is not None and frame > last_frame:
            continue
        map_d, map_g = (a[0] for a in noisy(point[None]))
        signed.append(map_d - d)
        error.append(abs(map_d - d))
        if d < 0.5:
            near.append(abs(map_d - d))
            near_signed.append(map_d - d)
        if math.dist(point, sensor) < 3:
            local.append(abs(map_d - d))
        eikonal.append(abs(math.hypot(*map_g) - 1))
        cosine.append(1 - sum(a * b for a, b in zip(map_g, g, strict=True)) / math.hypot(*map_g))
        band = ">50 cm"
        for end, name in ((0.5, "20-50 cm"), (0.2, "5-20 cm"), (0.05, "0-5 cm")):
            band = name if d < end else band
        is_local = math.dist(point, sensor) < 3
        bands[band].append((error[-1], eikonal[-1], cosine[-1], error[-1] if is_local else None))
        if d < radius:
            true += 1
            called_true += map_d < radius
        else:
            false += 1
            called_false += map_d < radius
    assert len(local) < len(error)  # the radius of 3 m must matter here
    expected = {
        "visible_cm": 100 * np.mean(error),
        "near_cm": 100 * np.mean(near),
        "within_3m_cm": 100 * np.mean(local),
        "bias_cm": 100 * np.mean(signed),
        "near_bias_cm": 100 * np.mean(near_signed),
        "eikonal": np.mean(eikonal),
        "cosine": np.mean(cosine),
        "recall": called_true / true,
        "fpr": called_false / false,
    }
    for key, value in expected.items():
        assert scores[key] == pytest.approx(value, rel=1e-4), key

    by_band = evaluate_bands(noisy, truth, sensor_position_world=sensor, last_frame=last_frame)
    assert list(by_band) == list(bands)
    for band, rows in bands.items():
        columns = list(zip(*rows, strict=True))
        assert len(rows) > 5
        expected = {
            "visible_cm": 100 * np.mean(columns[0]),
            "eikonal": np.mean(columns[1]),
            "cosine": np.mean(columns[2]),
            "within_3m_cm": 100 * np.mean([each for each in columns[3] if each is not None]),
        }
        assert by_band[band] == pytest.approx(expected, rel=1e-4), band


def test_the_surface_has_no_score_if_frames_are_left_out():
    truth = sphere_truth()
    assert math.isnan(evaluate(sphere, truth, last_frame=3)["surface_cm"])
    assert math.isfinite(evaluate(sphere, truth, last_frame=9)["surface_cm"])
    assert set(explain_missing(truth, 3)) == {"surface_cm"}
    assert explain_missing(truth, 9) == explain_missing(truth, None) == {}


def test_thin_parts_are_kept_within_2_cm():
    truth = sphere_truth()
    assert "thin_share" not in evaluate(sphere, truth)
    shift = np.array([-0.03, -0.019, 0, 0.019, 0.021], np.float32)
    direction = np.tile([[0, 0, 1]], (5, 1))
    thin = (CENTER + direction * (RADIUS + shift[:, None])).astype(np.float32)
    truth = truth._replace(thin_points_world=thin)
    assert evaluate(sphere, truth)["thin_share"] == pytest.approx(4 / 5)
    assert "thin_share" not in evaluate(sphere, truth, last_frame=4)  # thin points carry no frame
    assert math.isnan(evaluate(lambda p: (p[:, 0] * np.nan, p), truth)["thin_share"])


@pytest.mark.parametrize("count", [1, metrics._CHUNK, metrics._CHUNK + 1])
def test_a_jitted_map_compiles_once_and_keeps_the_order(count):
    traces = []

    @jax.jit
    def first_coordinate(points):
        traces.append(points.shape)
        return points[:, 0], points

    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    truth = GroundTruth(points, points[:, 0], points, np.zeros(count, np.int32), points[:3])
    scores = evaluate(first_coordinate, truth)
    assert scores["visible_cm"] == 0
    assert scores["cosine"] == pytest.approx(0, abs=1e-6)
    assert len(traces) == 1


def test_a_map_is_queried_at_the_given_points_only():
    truth = sphere_truth()
    asked = []

    def remember(points):
        asked.append(points)
        return sphere(points)

    evaluate(remember, truth)
    given = np.concatenate([truth.points_world, truth.surface_points_world])
    assert {*map(tuple, np.concatenate(asked))} == {*map(tuple, given)}


def test_gradients_of_zero_count_as_orthogonal():
    scores = evaluate(lambda p: (sphere(p)[0], np.zeros_like(p)), sphere_truth())
    assert scores["cosine"] == 1
    assert scores["eikonal"] == 1
    opposite = evaluate(lambda p: (sphere(p)[0], -sphere(p)[1]), sphere_truth())
    assert opposite["cosine"] == pytest.approx(2)


def test_a_map_that_returns_nan_scores_nan():
    def holed(points):
        sdf, grad = sphere(points)
        return np.where(points[:, 0] > 1, np.nan, sdf), grad

    scores = evaluate(holed, sphere_truth())
    for key in ("visible_cm", "bias_cm", "recall", "fpr"):
        assert math.isnan(scores[key]), key


def test_messages_name_the_wrong_argument():
    truth = sphere_truth(20)
    with pytest.raises(ValueError, match=r"truth.grad has shape \(20,\), expected \(20, 3\)"):
        evaluate(sphere, truth._replace(grad=truth.sdf))
    with pytest.raises(ValueError, match="last_frame = -1"):
        evaluate(sphere, truth, last_frame=-1)
    with pytest.raises(ValueError, match=r"sensor_position_world has shape \(2,\)"):
        evaluate(sphere, truth, sensor_position_world=[0, 0])
    with pytest.raises(ValueError, match=r"sdf of the map has shape \(8192, 1\) for 8192 points"):
        evaluate(lambda p: (sphere(p)[0][:, None], p), truth)
    with pytest.raises(ValueError, match="points_world has shape"):
        held_out_surface(lambda p: p[:, 0], np.zeros((0, 3)))


def test_held_out_surface():
    points = np.zeros((metrics._CHUNK + 9, 3), np.float32)
    points[:, 0] = np.linspace(-0.2, 0.2, len(points))
    scores = held_out_surface(lambda p: p[:, 0], points)
    assert scores["median_cm"] == pytest.approx(10, rel=1e-3)
    assert scores["mean_cm"] == pytest.approx(10, rel=1e-3)
    assert scores["p90_cm"] == pytest.approx(18, rel=1e-3)


@pytest.mark.skipif(not SHARED.exists(), reason="needs ../shared/data")
def test_recorded_distances_score_perfectly_against_themselves():
    from scipy.spatial import cKDTree

    truth = read_truth(SHARED / "house_depth.npz")
    points = np.concatenate([truth.points_world, truth.surface_points_world])
    sdf = np.concatenate([truth.sdf, np.zeros(len(truth.surface_points_world))])
    grad = np.concatenate([truth.grad, np.zeros_like(truth.surface_points_world)])
    tree = cKDTree(points)

    def lookup(query):
        nearest = tree.query(query)[1]
        return sdf[nearest], grad[nearest]

    scores = evaluate(lookup, truth)
    assert max(scores["visible_cm"], scores["surface_cm"], scores["fpr"]) == 0
    assert scores["recall"] == 1
    assert scores["cosine"] == pytest.approx(0, abs=1e-6)


def test_lower_bounds_are_scored_by_coverage_and_slack():
    truth = sphere_truth()

    def lower(points):
        sdf, _ = sphere(points)
        return np.where(points[:, 0] > CENTER[0], sdf - 0.03, sdf + 0.01)

    scores = evaluate_lower(lower, truth)
    share = np.mean(truth.points_world[:, 0] > CENTER[0])
    assert scores["lower_coverage"] == share
    assert scores["lower_slack_cm"] == pytest.approx(3 * share - (1 - share), abs=1e-3)
    early = truth.frame <= 3
    share = np.mean(truth.points_world[early, 0] > CENTER[0])
    assert evaluate_lower(lower, truth, 3)["lower_coverage"] == share
