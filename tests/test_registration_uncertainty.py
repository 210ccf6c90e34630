"""The covariance of a pose, against a pose that is solved without each cell of space in turn."""

import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.mapping.registration import comparing, equations, uncertainty

COUNT = 600
CELL_M = 1.0  # for a sensor that sees 2.5 m and farther


def residuals_of(seed, free=0):
    """Residuals at a minimum: the weighted sum of squares has no slope in bound directions."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(COUNT, 6))
    weight = 1e4 * rng.uniform(0.5, 2, COUNT)
    points = rng.uniform(0, 2 * CELL_M, (COUNT, 3))
    # One error per cell, and some of each return's own.
    cell = np.floor(points / CELL_M).astype(int)
    shared = rng.normal(size=(2, 2, 2))[tuple(cell.T)]
    distance = 0.05 * (shared + 0.3 * rng.normal(size=COUNT))
    bound = jacobian[:, free:]
    step = np.linalg.solve(bound.T @ (weight[:, None] * bound), bound.T @ (weight * distance))
    distance = distance - bound @ step
    parts = distance, jacobian, np.ones(COUNT), np.ones(COUNT, bool), np.zeros(COUNT, bool)
    return comparing.Residuals(
        *(jnp.asarray(part, jnp.float32 if part.dtype == float else None) for part in parts),
        weight=jnp.asarray(weight, jnp.float32),
        points_world=jnp.asarray(points, jnp.float32),
        width=jnp.zeros(COUNT),
    )


def rows():
    points = jnp.array([[3.0, 0, 0]])
    return comparing.make_rows(points, jnp.ones(1, bool), (0.01, 0.0))


def covariance(residuals, free=0):
    directions = equations.Directions(jnp.eye(6), jnp.arange(6) < free)
    anchor, made = equations.Anchor(jnp.eye(4), None), rows()
    found = uncertainty.covariance_of(residuals, directions, anchor, made)
    units = np.asarray(comparing.units(made), float)
    return units[:, None] * np.asarray(found, float) * units


def jackknife(residuals, free=0):
    """Solves the least-squares problem once per cell, in float64, without the cell's returns."""
    jacobian, distance, weight, points = (
        np.asarray(part, float)
        for part in (
            residuals.jacobian[:, free:],
            residuals.distance,
            residuals.weight,
            residuals.points_world,
        )
    )
    _, cell = np.unique(np.floor(points / CELL_M), axis=0, return_inverse=True)
    root = np.sqrt(weight)
    motions = []
    for left_out in range(cell.max() + 1):
        kept = cell.ravel() != left_out
        moved, *_ = np.linalg.lstsq(
            (root[:, None] * jacobian)[kept], -(root * distance)[kept], rcond=None
        )
        motions.append(moved)
    motions = np.array(motions)
    share = (len(motions) - 1) / len(motions)
    information = jacobian.T @ (weight[:, None] * jacobian)
    return share * motions.T @ motions + np.linalg.inv(information)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_that_of_poses_without_each_cell(seed):
    residuals = residuals_of(seed)
    expected = jackknife(residuals)
    scale = np.sqrt(np.diag(expected))
    close = np.abs(covariance(residuals) - expected) / scale[:, None] / scale
    assert close.max() < 5e-3
    information = np.asarray(comparing.information_of(residuals), float)
    assert np.linalg.norm(expected) > 3 * np.linalg.norm(np.linalg.inv(information))


def test_a_free_direction_has_a_deviation_of_100_m_and_no_part_in_the_others():
    residuals = residuals_of(5, free=2)
    found, expected = covariance(residuals, free=2), jackknife(residuals, free=2)
    np.testing.assert_allclose(np.diag(found)[:2], 100**2, rtol=1e-4)
    np.testing.assert_allclose(found[:2, 2:], 0, atol=1e-6)
    scale = np.sqrt(np.diag(expected))
    assert (np.abs(found[2:, 2:] - expected) / scale[:, None] / scale).max() < 5e-3


def test_cells_shrink_with_a_small_scene():
    """A scene half as large, with errors half as large, has a quarter of the variance."""
    large = residuals_of(7)
    small = large._replace(
        distance=large.distance / 2, weight=4 * large.weight, points_world=large.points_world / 2
    )
    half = comparing.make_rows(jnp.array([[1.25, 0, 0]]), jnp.ones(1, bool), (0.01, 0.0))
    full = comparing.make_rows(jnp.array([[2.5, 0, 0]]), jnp.ones(1, bool), (0.01, 0.0))
    directions = equations.Directions(jnp.eye(6), jnp.zeros(6, bool))
    anchor = equations.Anchor(jnp.eye(4), None)
    found = [
        np.asarray(uncertainty.covariance_of(part, directions, anchor, made))
        * np.outer(comparing.units(made), comparing.units(made))
        for part, made in ((large, full), (small, half))
    ]
    np.testing.assert_allclose(found[1], found[0] / 4, rtol=1e-3, atol=1e-9)


def test_a_single_cell_tells_no_more_than_independent_returns():
    residuals = residuals_of(6)._replace(points_world=jnp.full((COUNT, 3), 0.1))
    information = np.asarray(comparing.information_of(residuals), float)
    np.testing.assert_allclose(covariance(residuals), np.linalg.inv(information), rtol=1e-2)
    none = residuals._replace(weight=jnp.zeros(COUNT))
    assert np.all(np.isfinite(covariance(none, free=6)))
