"""Trajectory optimization: descent of the stated cost, taut strings, one compilation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trajectory as example
from analytic import baked, count_traces, equalities_with_least, half_space, half_spaces
from scene import ROOM, exact_sdf

from hiosdf_jax.planning import optimize_trajectory, waves

RADIUS, MARGIN = 0.1, 0.15
LATTICE = ([-1.2, -1.0, -0.2], [1.2, 1.0, 0.2], 0.04)  # corners and resolution, m
OPTIMIZE = jax.jit(partial(optimize_trajectory, radius_m=RADIUS, margin_m=MARGIN))


def reference_cost(path, exact):
    """Energy of the band plus mean squared intrusion, as in the docstring, float64."""
    segments = len(path) - 1
    spans = np.diff(path, axis=0)
    straight = np.linalg.norm(path[-1] - path[0])
    shares = np.arange(1, 5)[:, None, None] / 4
    intrusion = np.maximum(RADIUS + MARGIN - exact(path[:-1] + shares * spans), 0)
    per_segment = (intrusion**2).mean(axis=0) * np.linalg.norm(spans, axis=1)
    return segments * (spans**2).sum() / straight**2 + 2000 * per_segment.sum() / straight


def test_the_first_step_goes_down_the_stated_cost():
    """Adam's first step has the length of its rate in every coordinate, against the gradient."""
    rng = np.random.default_rng(0)
    normals, offsets, fields = half_spaces(8, reach=0.3)
    first = jax.jit(
        lambda field, path: optimize_trajectory(
            field, path, radius_m=RADIUS, margin_m=MARGIN, steps=1, step_m=1e-3
        )
    )
    for normal, offset, field in zip(normals, offsets, fields, strict=True):
        path = rng.uniform(-1, 1, (7, 3)).astype(np.float32)
        moved = first(field, path)
        step = np.asarray(moved.waypoints_world) - path
        np.testing.assert_array_equal(step[[0, -1]], 0)
        for row, axis in np.ndindex(5, 3):
            nudge = np.zeros((7, 3))
            nudge[row + 1, axis] = 1e-6
            slope = (
                reference_cost(path + nudge, lambda p, n=normal, o=offset: p @ n + o)
                - reference_cost(path - nudge, lambda p, n=normal, o=offset: p @ n + o)
            ) / 2e-6
            if abs(slope) > 0.05:
                np.testing.assert_allclose(step[row + 1, axis], -1e-3 * np.sign(slope), rtol=1e-2)


def test_around_an_edge_the_path_is_a_taut_string():
    """Around a wall that ends at (0, 0): two tangents and an arc of radius + margin."""

    def wall(points):
        x, y = points[..., 0], points[..., 1]
        return np.where(y < 0, np.abs(x), np.hypot(x, y)) - 0.02

    field = baked(wall, *LATTICE)
    start, goal = np.array([-0.9, -0.3, 0.0]), np.array([0.9, -0.3, 0.0])
    line = np.linspace(start, goal, 40)
    guess = line + 0.6 * np.sin(np.pi * np.linspace(0, 1, 40))[:, None] * [0, 1.0, 0]
    paths = OPTIMIZE(field, np.stack([guess] * 5))
    path = jax.tree.map(lambda array: array[0], paths)
    wanted = RADIUS + MARGIN + 0.02
    reach = np.hypot(0.9, 0.3)
    tangent = np.sqrt(reach**2 - wanted**2)
    # Half the angle between start and goal, seen from the edge, minus that to the tangent point.
    arc = np.pi - np.arctan2(0.9, 0.3) - np.arccos(wanted / reach)
    np.testing.assert_allclose(path.length, 2 * (tangent + wanted * arc), rtol=0.02)
    assert MARGIN - 0.04 < path.clearance < MARGIN + 0.01
    dense = np.asarray(path.waypoints_world, float)
    np.testing.assert_allclose(dense[0], start, atol=1e-6)
    np.testing.assert_allclose(dense[-1], goal, atol=1e-6)
    np.testing.assert_allclose(path.clearance, wall(dense).min() - RADIUS, atol=0.02)


def test_in_empty_space_every_guess_becomes_the_straight_line():
    low, high, resolution = (20 * np.array(part) for part in LATTICE)
    field = baked(lambda p: p[..., 2] + 50.0, low, high, resolution)
    start, goal = [0.0, 0.0, 0.0], [3.0, 1.0, -1.0]
    guesses = waves(jax.random.key(0), start, goal, count=5, waypoints=40, spread_m=0.5)
    np.testing.assert_allclose(guesses[0], np.linspace(start, goal, 40), atol=1e-5)
    assert np.abs(guesses[1:] - guesses[0]).max() > 0.3
    paths = OPTIMIZE(field, guesses)
    length = np.linalg.norm(goal)
    direction = np.array(goal) / length
    off_line = np.cross(np.asarray(paths.waypoints_world, float), direction)
    assert np.linalg.norm(off_line, axis=-1).max() < 0.02
    np.testing.assert_allclose(paths.length, length, rtol=1e-3)


def test_200_maps_compile_once_and_the_path_reacts():
    counted, traces = count_traces(
        lambda field, guess: optimize_trajectory(
            field, guess, radius_m=RADIUS, margin_m=MARGIN, steps=30
        )
    )
    planner = jax.jit(counted)
    guess = waves(jax.random.key(1), [-1, 0, 0], [1, 0, 0], count=2, waypoints=12, spread_m=0.1)
    normals, offsets, fields = half_spaces(200, reach=0.3)
    middles = []
    for normal, offset, field in zip(normals, offsets, fields, strict=True):
        paths = planner(field, guess)
        exact = np.asarray(paths.waypoints_world, float) @ normal + offset
        np.testing.assert_allclose(paths.clearance, exact.min(axis=1) - RADIUS, atol=1e-4)
        middles.append(np.asarray(paths.waypoints_world[0, 6]))
    assert len(traces) == 1
    assert (np.linalg.norm(np.diff(middles, axis=0), axis=1) > 0.02).mean() > 0.8
    assert equalities_with_least(lambda path: counted(fields[0], path).clearance, guess) == 0


def test_it_finds_paths_through_the_room():
    field = baked(exact_sdf, ROOM[0] - 0.2, ROOM[1] + 0.2, 0.1)
    for start, goal in example.QUERIES:
        line = np.linspace(start, goal, 32)
        assert example.exact_clearance(line) < 0
        path = example.plan(field, jnp.array(start), jnp.array(goal), jax.random.key(0), count=16)
        assert example.exact_clearance(path.waypoints_world) > 0.05
        assert path.length < 1.3 * np.linalg.norm(line[-1] - line[0])


def test_bad_arguments_are_refused():
    field = half_space([0, 0, 1.0], 0.0)
    with pytest.raises(ValueError, match=r"initial_world has shape \(2, 3\)"):
        optimize_trajectory(field, np.zeros((2, 3)), radius_m=0.1)
    with pytest.raises(ValueError, match="radius_m is -1"):
        optimize_trajectory(field, np.zeros((4, 3)), radius_m=-1)
    with pytest.raises(ValueError, match="margin_m is nan"):
        optimize_trajectory(field, np.zeros((4, 3)), radius_m=0.1, margin_m=np.nan)
    with pytest.raises(ValueError, match="steps is 1000000000000, expected at most"):
        optimize_trajectory(field, np.zeros((4, 3)), radius_m=0.1, steps=10**12)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"key": 5}, "key has dtype int32"),
        ({"key": "seed"}, "key is str"),
        ({"key": jax.random.split(jax.random.key(0))}, r"key has dtype .* shape \(2,\)"),
        ({"start_world": np.zeros(2)}, r"start_world has shape \(2,\)"),
        ({"goal_world": "there"}, "goal_world"),
        ({"count": 10**12}, "count is 1000000000000, expected at most"),
        ({"count": 10**6, "waypoints": 10**4}, "count is 1000000 and waypoints is 10000"),
        ({"spread_m": -1.0}, "spread_m is -1"),
    ],
)
def test_bad_arguments_of_waves_are_refused(arguments, words):
    good = {
        "key": jax.random.key(0),
        "start_world": np.zeros(3),
        "goal_world": np.ones(3),
        "count": 2,
        "waypoints": 4,
        "spread_m": 0.1,
    }
    assert waves(**good).shape == (2, 4, 3)
    assert waves(**good | {"key": jax.random.PRNGKey(0)}).shape == (2, 4, 3)
    with pytest.raises(ValueError, match=words):
        waves(**good | arguments)
