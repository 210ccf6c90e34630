"""Scores of meshes and steps against values known in closed form."""

import numpy as np
import pytest
import trimesh

from hiosdf_jax._src.scoring import surface
from hiosdf_jax.scoring import GroundTruth, evaluate_held_out_mesh, evaluate_mesh, evaluate_steps

pytest.importorskip("igl")

# A square plate at z = 0, seen from above.
PLATE = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])


def plate_truth(count=2000, thin=()):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0.2, 0.8, (count, 2)), rng.uniform(0.01, 0.2, count)])
    on_plate = points * [1, 1, 0]
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    frame = np.zeros(count, int)
    thin = np.reshape(thin, (-1, 3))
    return GroundTruth(points, points[:, 2], up, frame, on_plate, thin)


def to_plate(points):
    aside = np.maximum(np.abs(points[:, :2] - 0.5) - 0.5, 0)
    return np.sqrt(np.sum(aside**2, axis=1) + points[:, 2] ** 2)


def test_the_exact_mesh_scores_perfectly():
    scores = evaluate_mesh(PLATE, plate_truth(), to_plate)
    for name in ("mesh_accuracy_cm", "mesh_completeness_cm", "mesh_sdf_cm"):
        assert scores[name] == pytest.approx(0, abs=1e-5)
    for name in ("mesh_f_1cm", "mesh_f_2cm", "mesh_f_5cm"):
        assert scores[name] == 1


def test_a_raised_half_has_known_scores():
    """Half of the surface has a mesh, 1.5 cm too high; thin parts at known distances from it."""
    half = PLATE.copy()
    half.apply_scale([0.5, 1, 1])
    half.apply_translation([0, 0, 0.015])
    truth = plate_truth(thin=[[0.2, 0.2, 0.03], [0.2, 0.2, 0.04]])
    scores = evaluate_mesh(half, truth, to_plate)
    assert scores["mesh_accuracy_cm"] == pytest.approx(1.5)
    aside = np.maximum(truth.surface_points_world[:, 0] - 0.5, 0)
    away = np.hypot(aside, 0.015)
    assert scores["mesh_completeness_cm"] == pytest.approx(100 * away.mean())
    assert scores["mesh_f_1cm"] == 0
    for name, tolerance in (("mesh_f_2cm", 0.02), ("mesh_f_5cm", 0.05)):
        recall = np.mean(away < tolerance)
        assert scores[name] == pytest.approx(2 * recall / (1 + recall))
    below = np.hypot(aside, truth.sdf - 0.015)
    assert scores["mesh_sdf_cm"] == pytest.approx(100 * np.abs(below - truth.sdf).mean())
    assert scores["mesh_thin_share"] == 0.5


def test_without_the_exact_surface_there_is_no_accuracy():
    assert set(evaluate_mesh(PLATE, plate_truth())) == {"mesh_completeness_cm", "mesh_sdf_cm"}


def test_a_mesh_without_faces_scores_nan():
    scores = evaluate_mesh(trimesh.Trimesh(), plate_truth(), to_plate)
    assert scores and all(np.isnan(value) for value in scores.values())


def test_held_out_returns():
    points = np.column_stack([np.full((101, 2), 0.5), np.linspace(0, 0.1, 101)])
    scores = evaluate_held_out_mesh(PLATE, points)
    assert scores == pytest.approx({"mesh_median_cm": 5, "mesh_p90_cm": 9})


def test_steps(monkeypatch):
    """The distance from the plate, with a jump of 3 cm at x = 0.25; seen above z = -0.3."""
    monkeypatch.setattr(surface, "_SEGMENTS", 200_000)
    bounds = ((0, 0, -0.5), (1, 1, 0.5))

    def sdf(points):
        return points[:, 2] + np.where(points[:, 0] < 0.25, 0.03, 0.0)

    def observed(points):
        return points[:, 2] > -0.3

    scores = evaluate_steps(sdf, observed, bounds, PLATE, 0.1)
    # A segment of 2.5 mm has 1.25 mm along x on average.
    assert scores["steps_ppm"] == pytest.approx(1250, rel=0.15)
    assert 3 < scores["step_largest_cm"] < 3.26
    assert scores["far_flips_ppm"] == 0
    # The same with the sign change 10 cm above the plate, with voxels of 10 cm.
    scores = evaluate_steps(lambda points: sdf(points) - 0.1, observed, bounds, PLATE, 0.1)
    assert scores["far_flips_ppm"] > 1e6 * 1.25e-3
    scores = evaluate_steps(lambda points: sdf(points) - 0.1, observed, bounds, PLATE, 0.3)
    assert scores["far_flips_ppm"] == 0
