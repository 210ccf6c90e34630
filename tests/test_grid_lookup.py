"""The grid's distance at points: exact for a room, and for a sheet seen from both sides."""

import jax
import numpy as np
import pytest
from voxels import (
    CONFIG,
    anywhere,
    distance_at,
    empty_window,
    fuse,
    grid_of,
    grid_of_room,
    trace,
    uniform,
    update_distances,
)

from hiosdf_jax._src.grid import evidence, lookup, patches
from hiosdf_jax._src.state import surface_of


@pytest.fixture(scope="module")
def room():
    """Few views: walls have gaps between their patches."""
    return grid_of_room(range(2))


def test_distance_in_a_room_is_exact_in_value_sign_and_gradient():
    half, center = np.array([0.47, 0.38, 0.29]), np.array([0.3, 0.5, 0.6])
    surface = surface_of(grid_of_room(range(4)))
    points = uniform(11, 2000)
    gaps = half - np.abs(points - center)
    exact = np.where(
        (gaps > 0).all(axis=1), gaps.min(axis=1), -np.linalg.norm(np.minimum(gaps, 0), axis=1)
    )
    value, gradient = distance_at(surface, points)
    inside = exact > 0
    error = value - exact
    assert np.abs(error[inside]).mean() < 0.002
    # In the voxels of the room's edges a patch has no side; 2 cm away the sign is certain.
    assert (value[exact > 0.02] > 0).all()
    assert np.mean(value[inside] > 0) > 0.95
    shallow = (exact < -0.005) & (exact > -0.1)
    assert shallow.sum() > 50
    assert np.mean(value[shallow] < 0) > 0.95
    assert np.abs(error[shallow]).mean() < 0.01
    ordered = np.sort(gaps, axis=1)
    plain = inside & (exact > 0.01) & (ordered[:, 1] - ordered[:, 0] > 0.08)
    axis = np.argmin(gaps[plain], axis=1)
    normal = -np.sign(points - center)[plain] * (np.arange(3) == axis[:, None])
    assert np.mean(np.sum(gradient[plain] * normal, axis=1)) > 0.99
    assert np.isfinite(gradient).all()
    one_by_one = jax.jit(lookup.grid_sdf, static_argnums=0)
    single = [one_by_one(CONFIG, surface, point) for point in points[:20]]
    np.testing.assert_allclose(value[:20], single, atol=1e-6)


def test_distance_against_brute_force_over_all_patches(room):
    known = room.evidence
    features = np.asarray(patches.is_feature(CONFIG, known.hits, known.passes, known.axes))
    cells = np.argwhere(features)
    mean = np.asarray(known.mean, np.float64)[features] + cells + CONFIG.corner_index + 0.5
    axes = np.asarray(known.axes, np.float64)[features]
    points = uniform(12, 400).astype(np.float64)
    # float64 again, from the definition of a patch
    offset = points[:, None] / 0.1 - mean
    for k in range(2):
        half = 0.9 * 3**0.5 * axes[:, k]
        along = np.clip((offset * half).sum(-1) / np.maximum((half**2).sum(-1), 1e-12), -1, 1)
        offset = offset - along[..., None] * half
    exact = 0.1 * np.linalg.norm(offset, axis=-1).min(axis=1)
    value = np.abs(distance_at(surface_of(room), points)[0])
    assert (value - exact).min() > -1e-4
    assert np.mean(value - exact > 1e-4) < 0.02
    assert (value - exact).max() < 0.01


def test_a_sheet_seen_from_both_sides_is_free_on_both():
    window = empty_window()
    for side in (-1, 1):
        sensor = np.array([0.3 + side * 0.4, 0.5, 0.6])
        ends = uniform(13, 3000, (0.36, 0.1, 0.3), (0.36001, 0.9, 0.9))
        window = trace(fuse(window, ends, sensor), ends, sensor)
    grid = grid_of(window, evidence.empty_grid(CONFIG).derived)
    grid = update_distances(CONFIG, grid, anywhere((0.3, 0.5, 0.6)))
    points = uniform(14, 300, (0.2, 0.3, 0.45), (0.52, 0.7, 0.75))
    value, _ = distance_at(surface_of(grid), points)
    assert np.mean(value >= 0) > 0.99
    # Patches leave narrow gaps between each other: exact in the mean, within 1 cm everywhere.
    error = value - np.abs(points[:, 0] - 0.36)
    assert np.abs(error).mean() < 5e-4
    assert np.abs(error).max() < 0.01


def test_an_empty_grid_answers_the_horizon():
    surface = surface_of(evidence.empty_grid(CONFIG))
    value, gradient = distance_at(surface, uniform(15, 20))
    np.testing.assert_array_equal(value, np.full(20, 1.5, np.float32))
    assert np.isfinite(gradient).all()
