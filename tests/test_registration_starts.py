"""Coarse steps from several poses, where the first ones lead to a wrong minimum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import room_cloud

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.registration import comparing, equations, refining, solving

ROWS = comparing.make_rows(jnp.ones((8, 3)), jnp.ones(8, bool), (0.01, 0.001))


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


def search(monkeypatch, losses, starts, reach_m=0.7):
    """Searches where the mean loss at the given pose and at each other start is as given."""
    other = jnp.asarray(solving._OTHER_STARTS[:, :3])

    def compare(_, rows, pose, scale_m):
        way = jnp.linalg.norm(pose[:3, 3] - other, axis=1)
        number = jnp.where(jnp.min(way) < 1e-5, jnp.argmin(way) + 1, -1)  # elsewhere the last one
        number = jnp.where(jnp.linalg.norm(pose[:3, 3]) < 1e-5, 0, number)
        loss = jnp.asarray(losses, jnp.float32)[number]
        ratio = jnp.sqrt(loss / (1 - loss)) * comparing.INLIER_DEVIATIONS
        one, flag = jnp.ones(8), jnp.ones(8, bool)
        world = jnp.zeros((8, 3)) + 0 * scale_m
        return comparing.Residuals(
            ratio * one, jnp.zeros((8, 6)), one, flag, ~flag, one, world, 0 * one
        )

    sum_returns = lambda *arguments: comparing.sums_of(compare(*arguments))  # noqa: E731
    monkeypatch.setattr(solving, "sum_returns", sum_returns)
    anchor = equations.Anchor(jnp.eye(4), None)
    pose, _ = solving.solve_coarse(None, ROWS, jnp.eye(4), anchor, reach_m, starts)
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


@pytest.mark.parametrize(
    ("loss_there", "way_m", "starts", "kept"),
    [
        (0.009, 0.1, 5, True),
        (0.011, 0.1, 5, False),  # fits no better than by chance
        (0.009, 0.4, 5, False),  # eight standard deviations off
        (0.009, 0.1, 1, False),
    ],
)
def test_with_a_prior_the_second_start_trusts_it_less(monkeypatch, loss_there, way_m, starts, kept):
    information = jnp.eye(6) / 0.05**2

    def find_step(sums, axes, anchor, *_):
        lowered = anchor.information[0, 0] < 0.9 * information[0, 0]
        return jnp.where(lowered, way_m / solving._COARSE_STEPS, 0) * jnp.eye(6)[0]

    def sum_returns(field, rows, pose, scale_m):
        loss = jnp.where(pose[0, 3] > 0, loss_there, 0.02)
        values = jnp.zeros(31).at[27].set(loss * len(rows.some)).at[28].set(len(rows.some))
        return comparing.Sums(values.astype(jnp.float32))

    monkeypatch.setattr(solving, "find_step", find_step)
    monkeypatch.setattr(solving, "sum_returns", sum_returns)
    anchor = equations.Anchor(jnp.eye(4), information)
    pose, _ = solving.solve_coarse(None, ROWS, jnp.eye(4), anchor, 0.7, starts)
    # The last step to it lowers the information by half.
    np.testing.assert_allclose(pose[:3, 3], [way_m if kept else 0, 0, 0], atol=1e-6)


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
    residuals = comparing.Residuals(distance * one, zeros, one, *flags, one, zeros[:, :3], 0 * one)
    return equations.fit_of(comparing.sums_of(residuals), jnp.ones(count, bool))


def test_returns_in_free_space_are_lost():
    found = fit([1, 1, 0, 0], [0, 1, 1, 0])
    assert float(found.loss) == pytest.approx(1 / 3)
    assert float(found.known) == pytest.approx(3 / 4)
    assert float(fit([0, 0], [0, 0]).loss) == np.inf
    assert float(fit([1] + [0] * 19, [0] * 20).loss) == np.inf  # too few


@pytest.mark.parametrize("outliers", [2, 8, 15])
def test_a_pose_is_no_better_because_fewer_returns_can_be_compared(outliers):
    right = fit([1] * (100 - outliers) + [0] * outliers, [0] * (100 - outliers) + [1] * outliers)
    elsewhere = fit([1] * 20 + [0] * 80, [0] * 100)
    assert float(elsewhere.loss) < float(right.loss)
    assert not bool(equations.fits_better(elsewhere, right))
    assert bool(equations.fits_better(right, elsewhere))


def test_a_right_pose_is_better_although_more_of_its_returns_are_unknown():
    right = fit([1] * 60 + [0] * 40, [0] * 100, 0.36)  # loss 0.014
    wrong = fit([1] * 90 + [0] * 10, [0] * 100, 1.3)  # loss 0.16
    assert bool(equations.fits_better(right, wrong))
    nothing = fit([0] * 100, [0] * 100)
    assert bool(equations.fits_better(wrong, nothing))
    assert not bool(equations.fits_better(nothing, wrong))
    assert not bool(equations.fits_better(nothing, nothing))


def test_few_returns_that_fit_are_not_enough_to_stop(monkeypatch, begun):
    """A quarter of the returns fits, and the map tells nothing about the others."""

    def compare(_, rows, pose, scale_m):
        zero, flag = jnp.zeros(8) + 0 * scale_m + 0 * pose[0, 3], jnp.arange(8) < 2
        none, world = jnp.zeros(8, bool), jnp.zeros((8, 3))
        return comparing.Residuals(zero, jnp.zeros((8, 6)), zero + 1, flag, none, zero, world, zero)

    sum_returns = lambda *arguments: comparing.sums_of(compare(*arguments))  # noqa: E731
    monkeypatch.setattr(solving, "sum_returns", sum_returns)
    anchor = equations.Anchor(jnp.eye(4), None)
    solving.solve_coarse(None, ROWS, jnp.eye(4), anchor, 0.7, 3)
    jax.effects_barrier()
    assert begun() == [0, 1, 2]


@pytest.mark.parametrize("reach_m", [0.7, 0.2])
def test_starts_are_nearer_with_a_smaller_reach(monkeypatch, reach_m):
    poses = []

    def stay(residuals, axes, anchor, rows, pose, *_):
        jax.debug.callback(lambda pose: poses.append(np.asarray(pose)), pose)
        return jnp.zeros(6)

    monkeypatch.setattr(solving, "find_step", stay)
    search(monkeypatch, [0.5, 0.5, 0.5, 0.5, 0.5], 5, reach_m)
    ways = [np.linalg.norm(pose[:3, 3]) for pose in poses[:: solving._COARSE_STEPS]]
    np.testing.assert_allclose(ways, [0] + 4 * [0.15 * reach_m / 0.7], atol=1e-6)


def test_starts_that_end_far_away_or_nowhere_are_not_kept(monkeypatch, begun):
    far = np.eye(4, dtype=np.float32)
    far[0, 3] = 0.5
    for wrong in (far, np.full((4, 4), np.nan, np.float32)):

        def move(pose, motion, wrong=wrong):
            return jnp.where(jnp.any(motion != 0), wrong, pose)

        with monkeypatch.context() as patch:
            patch.setattr(solving, "move", move)
            pose = search(patch, [0.5, 0.0, 0.0, 0.0, 0.0], 5)
        np.testing.assert_array_equal(pose, np.eye(4))


def test_a_start_that_ends_nowhere_gives_way_to_others(monkeypatch):
    def lose(residuals, axes, anchor, rows, pose, *_):
        lost = jnp.linalg.norm(pose[:3, 3]) < 1e-5
        return jnp.where(lost, jnp.nan, jnp.zeros(6))

    monkeypatch.setattr(solving, "find_step", lose)
    pose = search(monkeypatch, [0.5, 0.4, 0.6, 0.7, 0.2], 5)
    np.testing.assert_allclose(pose[:3, 3], solving._OTHER_STARTS[3, :3], atol=1e-6)


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda *given: hio.refine_pose(*given), 5),
        (lambda *given: hio.refine_pose(*given, starts=2), 2),
        (lambda *given: hio.refine_pose(*given, prior=(np.eye(4), np.eye(6))), 5),
        (lambda *given: hio.track(*given), 5),
    ],
)
def test_starts_that_each_function_asks_for(monkeypatch, empty_map, call, expected):
    asked = []

    def note(field, rows, pose, anchor, reach_m, starts):
        asked.append(int(starts))
        return pose, rows.share

    monkeypatch.setattr(refining, "solve_coarse", note)
    cloud, pose = room_cloud(0)
    jax.eval_shape(lambda cloud: call(empty_map, cloud, pose), jnp.asarray(cloud))
    assert asked == [expected]


def test_places_are_found_from_one_start_each_and_are_differentiable(monkeypatch, empty_map):
    asked = []

    def note(field, rows, pose, anchor, reach_m, starts):
        asked.append(int(starts))
        return pose, rows.share

    def height(cloud, state):
        return hio.relocalize(state, cloud, jax.random.key(0), hypotheses=256).best.pose[2, 3]

    monkeypatch.setattr(refining, "solve_coarse", note)
    cloud, _ = room_cloud(0)
    slope = jax.eval_shape(jax.grad(height), jnp.asarray(cloud), empty_map)
    assert slope.shape == cloud.shape
    assert set(asked) == {1}
