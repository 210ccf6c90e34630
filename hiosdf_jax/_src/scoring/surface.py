"""Scores of a map's mesh, and of how evenly its distance changes from point to point."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.scoring.metrics import KEPT, in_chunks
from hiosdf_jax._src.scoring.scene import triangle_tree

if TYPE_CHECKING:
    import trimesh

_SAMPLES = 200_000  # points on the mesh
_F_TOLERANCES = {"mesh_f_1cm": 0.01, "mesh_f_2cm": 0.02, "mesh_f_5cm": 0.05}  # m

_SEGMENTS = 1_000_000  # in the box
_SEGMENT = 0.0025  # m
_STEP = 0.005  # m, twice what a distance can change along a segment


def evaluate_mesh(
    mesh: trimesh.Trimesh,
    truth: GroundTruth,
    true_distance: Callable[[np.ndarray], np.ndarray] | None = None,
) -> dict[str, float]:
    """Scores a mesh against the exact surface of a scene.

    Args:
        mesh: The mesh of a map, m, world frame.
        truth: Exact distances and surface points.
        true_distance: Maps (n, 3) points, m, world frame, to the distance from the exact surface,
            (n,) m, of any sign. Without it, accuracy and F-scores are left out.

    Returns:
        `mesh_accuracy_cm`: mean distance of 200,000 points on the mesh from the surface.
        `mesh_completeness_cm`: mean distance of the observed surface points from the mesh.
        `mesh_f_1cm`, `mesh_f_2cm`, `mesh_f_5cm`: F-score, the harmonic mean of the shares of both
            within the tolerance.
        `mesh_sdf_cm`: mean error of the distance to the mesh at the points of `truth`.
        `mesh_thin_share`: share of the points on thin parts within 2 cm of the mesh.
        NaN for a mesh without faces.

    Raises:
        ModuleNotFoundError: libigl is not installed.

    Example:
        scores = scoring.evaluate_mesh(hio.extract_mesh(field), truth)
    """
    to_mesh = _distance_to(mesh)
    complete = to_mesh(truth.surface_points_world)
    error = to_mesh(truth.points_world) - np.abs(truth.sdf)
    scores = {
        "mesh_completeness_cm": 100 * float(np.mean(complete)),
        "mesh_sdf_cm": 100 * float(np.mean(np.abs(error))),
    }
    if len(truth.thin_points_world):
        scores["mesh_thin_share"] = _share(to_mesh(truth.thin_points_world), KEPT)
    if true_distance is not None and len(mesh.faces):
        import trimesh

        points = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)[0]
        accurate = np.abs(true_distance(np.asarray(points, float)))
        scores["mesh_accuracy_cm"] = 100 * float(np.mean(accurate))
        for name, tolerance in _F_TOLERANCES.items():
            shares = _share(accurate, tolerance), _share(complete, tolerance)
            scores[name] = 2 * shares[0] * shares[1] / max(sum(shares), 1e-9)
    return scores


def evaluate_held_out_mesh(mesh: trimesh.Trimesh, points_world: np.ndarray) -> dict[str, float]:
    """Scores a mesh of a real stream on returns that the map was not given.

    Args:
        mesh: The mesh, m, world frame.
        points_world: (N, 3) m.

    Returns:
        `mesh_median_cm` and `mesh_p90_cm` of the returns' distances from the mesh.

    Raises:
        ModuleNotFoundError: libigl is not installed.

    Example:
        mesh = hio.extract_mesh(field)
        scores = scoring.evaluate_held_out_mesh(mesh, returns_world)
    """
    distance_cm = 100 * _distance_to(mesh)(points_world)
    return {
        "mesh_median_cm": float(np.median(distance_cm)),
        "mesh_p90_cm": float(np.percentile(distance_cm, 90)),
    }


def evaluate_steps(
    sdf: Callable[[np.ndarray], Any],
    observed: Callable[[np.ndarray], Any],
    bounds: Any,
    mesh: trimesh.Trimesh,
    voxel_size: float,
) -> dict[str, float]:
    """Scores how a map's distance changes along segments of 2.5 mm in observed space.

    A million segments are drawn in the box; those with both ends in observed space count.

    Args:
        sdf: Maps (n, 3) float32 points, m, world frame, to (n,) distances, m.
        observed: Maps (n, 3) float32 points to (n,) bool.
        bounds: Corners of the box to draw from, (3,) m each.
        mesh: The map's mesh.
        voxel_size: Edge of the map's voxels, m.

    Returns:
        `steps_ppm`: segments along which the distance changes by more than 5 mm, per million.
        `step_largest_cm`: the largest change.
        `far_flips_ppm`: segments along which the sign changes although their start is farther than
            half a voxel and 2.5 mm from the mesh, per million.

    Raises:
        ModuleNotFoundError: libigl is not installed.

    Example:
        scores = scoring.evaluate_steps(
            lambda points: hio.sdf(field, points),
            lambda points: hio.query(field, points).observed,
            config.bounds,
            hio.extract_mesh(field),
            config.voxel_size,
        )
    """
    rng = np.random.default_rng(0)
    low, high = np.asarray(bounds, float)
    start = rng.uniform(low, high, (_SEGMENTS, 3))
    turn = rng.normal(size=(_SEGMENTS, 3))
    end = start + _SEGMENT * turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    end = np.clip(end, low, high)
    seen = in_chunks(observed, start, bool) & in_chunks(observed, end, bool)
    start, end = start[seen], end[seen]
    first, last = in_chunks(sdf, start), in_chunks(sdf, end)
    step = np.abs(last - first)
    flips = start[(first < 0) != (last < 0)]
    far = np.sum(_distance_to(mesh)(flips) > 0.5 * voxel_size + _SEGMENT)
    return {
        "steps_ppm": 1e6 * float(np.mean(step > _STEP)),
        "step_largest_cm": 100 * float(np.max(step)),
        "far_flips_ppm": 1e6 * float(far) / len(start),
    }


def _distance_to(mesh: trimesh.Trimesh) -> Callable[[np.ndarray], np.ndarray]:
    """Returns the distance of points (n, 3) from a mesh, (n,) m; NaN without faces."""
    if not len(mesh.faces):
        return lambda points: np.full(len(points), np.nan)
    vertices, faces, tree = triangle_tree(mesh)

    def distance(points: np.ndarray) -> np.ndarray:
        if not len(points):
            return np.empty(0)
        squared, _, _ = tree.squared_distance(vertices, faces, np.array(points, float))
        return np.sqrt(np.maximum(squared, 0))

    return distance


def _share(distance: np.ndarray, tolerance: float) -> float:
    return float(np.mean(distance < tolerance))
