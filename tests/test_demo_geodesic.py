"""The floor's cells, what a map knows of them, and the cheapest paths over them."""

import math

import numpy as np
from analytic import baked
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hiosdf_jax._src.demo.geodesic import Floor, cost_to_go, heading_along, lay_floor, survey
from hiosdf_jax._src.demo.robot import Robot

ROBOT = Robot(heights=(0.3, 0.5))
BOUNDS = ((0.0, 0.0, 0.0), (4.0, 3.0, 1.0))


def test_a_point_is_in_the_cell_with_the_nearest_center():
    floor = lay_floor(BOUNDS, 0.1)
    assert floor.shape == (40, 30)
    centers = floor.centers()
    np.testing.assert_allclose(centers[0, 0], [0.05, 0.05])
    np.testing.assert_allclose(centers[-1, -1], [3.95, 2.95])
    assert floor.cell(centers[7, 11] + 0.04) == (7, 11)
    assert floor.cell(np.array([-9, 99])) == (0, 29)


def test_survey_knows_gaps_in_observed_space():
    floor = lay_floor(BOUNDS, 0.1)

    def to_wall(points):
        return 2.0 - points[..., 0]

    cells = survey(ROBOT, baked(to_wall, *BOUNDS, 0.1, frontier=to_wall), floor)
    x = floor.centers()[..., 0]
    seen = x < 2.0
    np.testing.assert_allclose(cells.gap[seen], 1.8 - x[seen], atol=1e-4)
    # The distance counts, without its sign, a few voxels behind the surface and no farther.
    np.testing.assert_allclose(cells.gap[x > 2.35], np.inf)
    behind = (x > 2.0) & (x < 2.25)
    np.testing.assert_allclose(cells.gap[behind], x[behind] - 2.2, atol=1e-4)
    np.testing.assert_array_equal(cells.seen, x < 1.76)


def test_cost_to_go_equals_dijkstra():
    rng = np.random.default_rng(0)
    floor = Floor(np.array([0.1, 0.2]), 0.1, (9, 7))
    costs = rng.uniform(1, 5, floor.shape)
    goal = floor.centers()[6, 2]
    to_go, path_from = cost_to_go(costs, floor, goal)
    count = costs.size
    edges = np.zeros((count, count))
    for i, j in np.ndindex(*floor.shape):
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a, b = i + di, j + dj
            if 0 <= a < 9 and 0 <= b < 7:
                mean = (costs[i, j] + costs[a, b]) / 2
                length = 0.1 * math.hypot(di, dj) * mean
                edges[i * 7 + j, a * 7 + b] = edges[a * 7 + b, i * 7 + j] = length
    reference = dijkstra(csr_matrix(edges), indices=6 * 7 + 2).reshape(floor.shape)
    np.testing.assert_allclose(to_go, reference, atol=1e-9)
    path = path_from(floor.centers()[0, 6])
    np.testing.assert_allclose(path[0], floor.centers()[0, 6])
    np.testing.assert_allclose(path[-1], goal)
    assert np.abs(np.diff(path, axis=0)).max() < 0.1 + 1e-9


def test_heading_points_a_little_ahead_along_the_path():
    path = np.array([[0, 0], [0.5, 0], [1, 0], [1, 1.0], [1, 2]])
    np.testing.assert_allclose(heading_along(path, np.array([1.0, 0.1])), [0, 1])
    np.testing.assert_allclose(heading_along(path, np.array([0.1, 0.0])), [1, 0])
    np.testing.assert_allclose(heading_along(path, np.array([1.0, 2.0])), [0, 0])
