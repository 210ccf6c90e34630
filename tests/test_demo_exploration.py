"""The exploring robot: its problem, its camera, when it looks around, and one whole run."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import distance_transform_edt, label

from hiosdf_jax import demo
from hiosdf_jax._src.command import cli

pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from hiosdf_jax._src.demo import exploration
from hiosdf_jax._src.demo.geodesic import Survey, lay_floor
from hiosdf_jax._src.demo.problem import draw_problem, exact_clearance
from hiosdf_jax._src.demo.sensing import CAMERA_HEIGHT, camera_pose

ROBOT = exploration.ROBOT


@pytest.fixture(scope="module")
def model():
    return demo.load_model()


def test_exact_clearance_is_that_of_the_capsule(model):
    # Beside the living room's column of radius 0.15 m at (4.15, 2.1).
    xy = np.array([[3.7, 2.1], [4.6, 2.1], [4.15, 2.4]])
    np.testing.assert_allclose(exact_clearance(model, ROBOT, xy), [0.1, 0.1, -0.05], atol=1e-9)
    # In open space the floor is nearest to its underside.
    np.testing.assert_allclose(exact_clearance(model, ROBOT, [[3.0, 3.5]]), [0.15], atol=1e-9)


def test_problems_are_solvable_and_not_trivial(model):
    floor = lay_floor(exploration.BOUNDS_WORLD, 0.14)
    gap = exact_clearance(model, ROBOT, floor.centers().reshape(-1, 2)).reshape(floor.shape)
    regions, _ = label(gap > 0.08)
    kinds = set()
    for seed in range(4):
        problem = draw_problem(model, ROBOT, floor, CAMERA_HEIGHT, seed)
        start, goal = floor.cell(problem.start[:2]), floor.cell(problem.goal)
        assert regions[start] == regions[goal] != 0
        free = 0.14 * distance_transform_edt(gap > 0.08)
        assert free[start] > 0.15 and free[goal] > 0.15
        assert problem.rooms[0] != problem.rooms[1]
        along = np.linspace(0, 1, 50)[:, None]
        between = problem.start[:2] + along * (problem.goal - problem.start[:2])
        points = np.column_stack([between, np.full(50, 1.1)])
        assert demo.signed_distance(model, points)[0].min() < 0.05
        kinds.add(problem.rooms)
    assert len(kinds) >= 3
    again = draw_problem(model, ROBOT, floor, CAMERA_HEIGHT, 3)
    np.testing.assert_array_equal(again.start, problem.start)


def test_the_camera_looks_ahead_and_down_from_the_body_front():
    tilt = np.radians(25)
    pose = camera_pose(np.array([2.0, 3.0, np.pi / 2, 0, 0]), tilt)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], [2.0, 3.2, 1.1])
    np.testing.assert_allclose(pose[:3, 2], [0, np.cos(tilt), -np.sin(tilt)], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 0], [1, 0, 0], atol=1e-12)  # right, looking north: east


def test_hiosdf_demo_plan_brings_the_robot_to_its_goal(tmp_path, capsys):
    assert cli.main(["demo", "--plan", "--seed", "1", "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    metrics = json.loads((tmp_path / "metrics.json").read_text("utf-8"))
    assert metrics["reached"] and not metrics["collided"]
    assert metrics["least_clearance_m"] > 0.02
    assert metrics["unknown"] == "obstacle" and metrics["from"] != metrics["to"]
    assert metrics["path_m"] >= np.hypot(*np.subtract(metrics["goal"], metrics["start"][:2])) - 0.25
    assert f"from the {metrics['from']} to the {metrics['to']}" in printed
    with Image.open(tmp_path / "plan.png") as picture:
        assert picture.width > 1000
    with Image.open(tmp_path / "plan.gif") as film:
        assert 3 <= film.n_frames <= 61


def test_options_of_the_mapping_demo_are_refused_with_plan(tmp_path, capsys):
    for option in (["--frames", "3"], ["--config", "paper"]):
        arguments = ["demo", "--plan", "--output", str(tmp_path / "none"), *option]
        assert cli.main(arguments) == 2
        assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def still(x, turn_rate=0.0):
    return np.array([x, 0.0, 0.0, 0.0, turn_rate])


def seconds_until(condition, watch, state):
    for count in range(1, 1000):
        vain = watch.looked_in_vain(state)
        if condition(watch):
            return count * ROBOT.step, vain
    raise AssertionError("never")


def test_a_stuck_robot_looks_around_and_gives_up_the_second_time():
    watch = exploration._Watch(np.zeros(2))
    assert watch.turning
    turn = seconds_until(lambda w: not w.turning, watch, still(0, 1.5))
    assert turn == (pytest.approx(2 * np.pi / 1.5, abs=ROBOT.step), False)
    for x in np.linspace(0, 2, 100):  # slow, but not stuck
        assert not watch.looked_in_vain(still(x)) and not watch.turning
    seconds, vain = seconds_until(lambda w: w.turning, watch, still(2))
    assert seconds == pytest.approx(5, abs=2) and not vain
    seconds_until(lambda w: not w.turning, watch, still(2, -1.5))
    assert seconds_until(lambda w: w.turning, watch, still(2.1))[1]
    assert len(watch.places) == 3


def test_only_unseen_cells_just_ahead_are_barred():
    floor = lay_floor(((0, 0, 0), (3, 1, 1)), 0.1)
    x = floor.centers()[..., 0]
    cells = Survey(gap=np.ones(floor.shape), seen=x < 1.0)
    path = np.column_stack([np.arange(0.55, 2.6, 0.07), np.full(30, 0.55)])
    barred = exploration._bar(floor, path, cells)
    # One cell around the unseen cells up to 1 m ahead.
    np.testing.assert_array_equal(barred[:, 5], (x[:, 0] > 0.9) & (x[:, 0] < 1.7))
    assert not barred[:, :4].any() and not barred[:, 7:].any()
