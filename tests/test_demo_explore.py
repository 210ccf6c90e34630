"""The exploring robot: what it is asked, what its camera sees, and one whole run."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import distance_transform_edt, label

from hiosdf_jax import demo
from hiosdf_jax._src.command import cli

pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from hiosdf_jax._src.demo import exploration, navigate


@pytest.fixture(scope="module")
def model():
    return demo.load_model()


def test_the_exact_clearance_is_that_of_the_capsule(model):
    # Beside the column of the living room, of radius 0.15 m at (4.15, 2.1).
    xy = np.array([[3.7, 2.1], [4.6, 2.1], [4.15, 2.4]])
    np.testing.assert_allclose(exploration.exact_clearance(model, xy), [0.1, 0.1, -0.05], atol=1e-9)
    # Where nothing is near it is the height of its underside over the floor.
    np.testing.assert_allclose(exploration.exact_clearance(model, [[3.0, 3.5]]), [0.15], atol=1e-9)


def test_problems_are_solvable_and_not_trivial(model):
    plane = navigate.lay_plane(exploration.BOUNDS_WORLD, 0.1)
    gap = exploration.exact_clearance(model, plane.centres().reshape(-1, 2)).reshape(plane.shape)
    regions, _ = label(gap > 0.08)
    kinds = set()
    for seed in range(4):
        problem = exploration.draw_problem(model, seed)
        start, goal = plane.cell(problem.start[:2]), plane.cell(problem.goal)
        assert regions[start] == regions[goal] != 0
        free = 0.1 * distance_transform_edt(gap > 0.08)
        assert free[start] > 0.15 and free[goal] > 0.15
        assert problem.rooms[0] != problem.rooms[1]
        along = np.linspace(0, 1, 50)[:, None]
        between = problem.start[:2] + along * (problem.goal - problem.start[:2])
        points = np.column_stack([between, np.full(50, 1.1)])
        assert demo.signed_distance(model, points)[0].min() < 0.05
        kinds.add(problem.rooms)
    assert len(kinds) >= 3
    np.testing.assert_array_equal(exploration.draw_problem(model, 3).start, problem.start)


def test_the_camera_looks_ahead_and_down_from_the_front_of_the_body():
    tilt = np.radians(25)
    pose = exploration.camera_pose(np.array([2.0, 3.0, np.pi / 2, 0, 0]), tilt)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], [2.0, 3.2, 1.1])
    np.testing.assert_allclose(pose[:3, 2], [0, np.cos(tilt), -np.sin(tilt)], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 0], [1, 0, 0], atol=1e-12)  # right, looking north: east


def test_hiosdf_demo_plan_brings_the_robot_to_its_goal(tmp_path, capsys):
    assert cli.main(["demo", "--plan", "--seed", "1", "--output", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    metrics = json.loads((tmp_path / "metrics.json").read_text("utf-8"))
    assert metrics["reached"] and not metrics["collided"]
    assert metrics["least_clearance_m"] > 0.02
    assert metrics["unknown"] == "obstacle" and metrics["from"] != metrics["to"]
    assert metrics["path_m"] >= np.hypot(*np.subtract(metrics["goal"], metrics["start"][:2])) - 0.25
    assert f"from the {metrics['from']} to the {metrics['to']}" in told
    with Image.open(tmp_path / "plan.png") as picture:
        assert picture.width > 1000
    with Image.open(tmp_path / "plan.gif") as film:
        assert 3 <= film.n_frames <= 61


def test_options_of_the_mapping_demo_do_not_go_with_plan(tmp_path, capsys):
    for option in (["--frames", "3"], ["--config", "paper"]):
        arguments = ["demo", "--plan", "--output", str(tmp_path / "none"), *option]
        assert cli.main(arguments) == 2
        assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def still(x, turn_rate=0.0):
    return np.array([x, 0.0, 0.0, 0.0, turn_rate])


def steps_until(condition, watch, state):
    for count in range(1, 1000):
        vain = watch.looked_in_vain(state)
        if condition(watch):
            return count * exploration.ROBOT.step, vain
    raise AssertionError("never")


def test_a_robot_that_is_stuck_looks_around_and_the_second_time_gives_up():
    watch = exploration._Watch(np.zeros(2))
    assert watch.turning
    turn = steps_until(lambda w: not w.turning, watch, still(0, 1.5))
    assert turn == (pytest.approx(2 * np.pi / 1.5, abs=exploration.ROBOT.step), False)
    for x in np.linspace(0, 2, 100):  # slow, but it gets on
        assert not watch.looked_in_vain(still(x)) and not watch.turning
    seconds, vain = steps_until(lambda w: w.turning, watch, still(2))
    assert seconds == pytest.approx(5, abs=2) and not vain
    steps_until(lambda w: not w.turning, watch, still(2, -1.5))
    assert steps_until(lambda w: w.turning, watch, still(2.1))[1]
    assert len(watch.places) == 3


def test_the_way_that_is_given_up_is_what_was_not_seen_just_ahead():
    plane = navigate.lay_plane(((0, 0, 0), (3, 1, 1)), 0.1)
    x = plane.centres()[..., 0]
    cells = navigate.Survey(gap=np.ones(plane.shape), seen=x < 1.0)
    path = np.column_stack([np.arange(0.55, 2.6, 0.07), np.full(30, 0.55)])
    barred = exploration._bar(plane, path, cells)
    # From the first unseen cell, and one cell around, to a metre ahead.
    np.testing.assert_array_equal(barred[:, 5], (x[:, 0] > 0.9) & (x[:, 0] < 1.7))
    assert not barred[:, :4].any() and not barred[:, 7:].any()
