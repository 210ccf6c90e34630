"""Coarse steps from several poses, where the first ones lead to a wrong minimum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.mapping.registration import equations, solving

ROWS = equations.make_rows(jnp.ones((8, 3)), jnp.ones(8, bool), (0.01, 0.001))


@pytest.fixture
def begun(monkeypatch):
    """Steps that stay where they begin; notes the starts, as numbers of `_OTHER_STARTS`."""
    numbers = []

    def note(pose):
        way = np.linalg.norm(pose[:3, 3] - solving._OTHER_STARTS[:, :3], axis=1)
        numbers.append(int(np.argmin(way)) + 1 if way.min() < 1e-5 else 0)

    def stay(residuals, axes, anchor, rows, pose, *_):
        jax.debug.callback(note, pose)
        return jnp.zeros(6)

    monkeypatch.setattr(solving, "find_step", stay)
    return lambda: [numbers[i] for i in range(0, len(numbers), solving._COARSE_STEPS)]


def search(monkeypatch, losses, starts):
    """Searches where the mean loss at the given pose and at each other start is as given."""
    other = jnp.asarray(solving._OTHER_STARTS[:, :3])

    def compare(_, rows, pose, scale_m):
        way = jnp.linalg.norm(pose[:3, 3] - other, axis=1)
        number = jnp.where(jnp.min(way) < 1e-5, jnp.argmin(way) + 1, 0)
        loss = jnp.asarray(losses, jnp.float32)[number]
        ratio = jnp.sqrt(loss / (1 - loss)) * equations.INLIER_DEVIATIONS
        one, flag = jnp.ones(8), jnp.ones(8, bool)
        world = jnp.zeros((8, 3)) + 0 * scale_m
        return equations.Residuals(ratio * one, jnp.zeros((8, 6)), one, flag, ~flag, one, world)

    monkeypatch.setattr(solving, "compare", compare)
    anchor = equations.Anchor(jnp.eye(4), None)
    pose = solving.solve_coarse(None, ROWS, jnp.eye(4), anchor, 0.7, starts)
    jax.effects_barrier()
    return np.asarray(pose)


@pytest.mark.parametrize(
    ("losses", "starts", "tried", "best"),
    [
        ([0.01, 0.0, 0.0, 0.0, 0.0], 5, [0], 0),
        ([0.5, 0.4, 0.3, 0.02, 0.0], 5, [0, 1, 2, 3], 3),
        ([0.5, 0.4, 0.3, 0.02, 0.0], 3, [0, 1, 2], 2),
        ([0.5, 0.4, 0.6, 0.7, 0.45], 5, [0, 1, 2, 3, 4], 1),
        ([0.5, 0.0, 0.0, 0.0, 0.0], 1, [0], 0),
    ],
)
def test_starts_are_tried_until_the_returns_fit(monkeypatch, begun, losses, starts, tried, best):
    pose = search(monkeypatch, losses, starts)
    assert begun() == tried
    expected = np.zeros(3) if best == 0 else solving._OTHER_STARTS[best - 1, :3]
    np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-6)


def test_other_starts_are_15_cm_and_6_degrees_away_in_all_directions():
    ways, turns = solving._OTHER_STARTS[:, :3], solving._OTHER_STARTS[:, 3:]
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 0.15, rtol=1e-6)
    np.testing.assert_allclose(np.degrees(np.linalg.norm(turns, axis=1)), 6, atol=0.02)
    for vectors in (ways, turns):
        np.testing.assert_allclose(vectors.sum(axis=0), 0, atol=1e-7)


def fit(on_surface, in_free_space, distance=0.0):
    flags = [jnp.asarray(each, bool) for each in (on_surface, in_free_space)]
    count = len(on_surface)
    one, zeros = jnp.ones(count), jnp.zeros((count, 6))
    residuals = equations.Residuals(distance * one, zeros, one, *flags, one, zeros[:, :3])
    return equations.fit_of(residuals, jnp.ones(count, bool))


def test_returns_in_free_space_are_lost_and_unknown_ones_cost_a_tenth():
    found = fit([1, 1, 0, 0], [0, 1, 1, 0])
    assert float(found.loss) == pytest.approx(1 / 3)
    assert float(found.of_all) == pytest.approx((1 + 0.1) / 4)
    nothing = fit([0, 0], [0, 0])
    assert float(nothing.loss) == np.inf
    assert float(nothing.of_all) == pytest.approx(0.1)


def test_a_pose_is_no_better_because_fewer_returns_can_be_compared():
    all_known = fit([1] * 10, [0] * 10, 0.6)  # loss 0.04
    few_known = fit([1] * 2 + [0] * 8, [0] * 10, 0.3)  # loss 0.01
    assert float(few_known.loss) < float(all_known.loss)
    assert float(few_known.of_all) > float(all_known.of_all)
