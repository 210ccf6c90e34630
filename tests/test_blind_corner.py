"""The blind-corner benchmark: its ray caster, its scenes, and one run."""

import jax
import numpy as np
import pytest

pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
from benchmarks import blind_corner as corner
from hiosdf_jax._src.demo.driver import make_driver
from hiosdf_jax._src.demo.sensing import map_config


def test_distances_to_boxes_by_hand():
    boxes = np.array([[(0, 0, 0), (1, 2, 3)], [(5, 0, 0), (6, 1, 1)]], float)
    points = np.array([(-1, 1, 1), (2, 3, 1), (0.5, 1, 1), (4.5, 0.5, 0.5), (2, 3, 4)], float)
    expected = [1, np.sqrt(2), -0.5, 0.5, np.sqrt(3)]
    np.testing.assert_allclose(corner.exact_sdf(boxes, points), expected, atol=1e-12)


def test_rays_end_at_the_first_surface():
    """Checked against sphere tracing, an independent caster."""
    scene = corner.draw_scene(0)
    origin = np.array([*scene.start, corner.SENSOR_HEIGHT])
    directions = corner.lidar_directions()[::37]
    ranges = corner.cast(scene.boxes, origin, directions)
    traced = np.zeros(len(directions))
    for _ in range(2000):
        traced += corner.exact_sdf(scene.boxes, origin + traced[:, None] * directions)
    np.testing.assert_allclose(ranges, traced, atol=1e-3)


def test_scenes_hide_the_box_and_leave_a_path():
    for seed in range(100):
        scene = corner.draw_scene(seed)
        height = corner.SENSOR_HEIGHT
        for xy in (scene.start, scene.goal):
            gap = corner.exact_sdf(scene.boxes, np.array([[*xy, height]]))[0]
            assert gap > corner.ROBOT.radius + 0.05
        # From the start no ray hits the last box, the one behind the corner.
        origin, last = np.array([*scene.start, height]), len(scene.boxes) - 1
        without = corner.cast(scene.boxes[:last], origin, corner.lidar_directions())
        with_it = corner.cast(scene.boxes, origin, corner.lidar_directions())
        assert (with_it < without - 1e-9).mean() < 0.01
        # The robot and its margin fit beside the box.
        (low, high), inner = scene.boxes[last], scene.boxes[5, 1, 0]
        far = scene.boxes[4, 0, 0]
        room = max(low[0] - inner, far - high[0])
        assert room >= 2 * (corner.ROBOT.radius + corner.ROBOT.margin) + 0.1


def test_with_unseen_space_as_an_obstacle_the_robot_gets_around_the_corner(monkeypatch):
    # The corridor fits into the exploring robot's map, whose update other tests compile too.
    (low, high), (inner_low, inner_high) = map_config().bounds, corner.map_config().bounds
    assert np.less_equal(low, inner_low).all() and np.less_equal(inner_high, high).all()
    monkeypatch.setattr(corner, "map_config", map_config)
    # With seed 3 and the network's prediction the robot hits the box.
    driver = make_driver(corner.ROBOT, "obstacle", jax.random.key(0), horizon=20)
    run = corner.run(corner.draw_scene(3), 3, "obstacle", driver)
    assert run["reached"] and not run["collided"]
    assert run["least_clearance_m"] > 0.02
