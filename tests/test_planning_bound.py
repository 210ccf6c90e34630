"""Planning on the lower bound, and what a baked window says outside of itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, HALF

import hiosdf_jax as hio
from hiosdf_jax import planning
from hiosdf_jax._src.field import queries

COUNT = 2000  # as many as in other tests: one compilation
RADII = np.full(COUNT, 0.05, np.float32)
STEP = 1e-3


@pytest.fixture(scope="module")
def fields(room_map):
    return {"map": hio.snapshot(room_map), "baked": hio.bake(room_map, 0.1)}


def draw(low, high, seed=0):
    return np.random.default_rng(seed).uniform(low, high, (COUNT, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", ["map", "baked"])
def test_the_lower_bound_is_that_of_query_where_the_network_answers(fields, kind):
    points = draw(*BOUNDS) * 1.2
    answer = hio.query(fields[kind], points)
    clearance = planning.sphere_clearance(
        fields[kind], points, RADII, unknown="network", bound="lower"
    )
    np.testing.assert_allclose(clearance, answer.lower - RADII, atol=1e-6)
    value, slope = planning.sphere_clearance_and_grad(
        fields[kind], points, RADII, unknown="network", bound="lower"
    )
    np.testing.assert_allclose(value, clearance, atol=1e-6)
    np.testing.assert_allclose(slope, answer.lower_grad, atol=1e-5)


@pytest.mark.parametrize("kind", ["map", "baked"])
def test_the_lower_bound_is_solid_in_unseen_space_and_leads_out_of_it(fields, kind):
    points = draw(*BOUNDS) * 1.2
    frontier = np.asarray(hio.query(fields[kind], points).frontier)
    value, slope = queries.distance_and_grad(fields[kind], points, "obstacle", "lower")
    lower = hio.query(fields[kind], points).lower
    assert (value <= frontier + 1e-6).all()
    seen = frontier > 0
    assert seen.any() and not seen.all()
    np.testing.assert_allclose(value[seen], np.minimum(lower, frontier)[seen], atol=1e-6)
    deep = frontier < -0.4
    _, out = queries.distance_and_grad(fields[kind], points, "obstacle", "sdf")
    np.testing.assert_allclose(slope[deep], out[deep], atol=1e-5)


# The nearest points of a map's patches are approximate, so its slopes are those of `sdf_and_grad`:
# off by about as much.
@pytest.mark.parametrize(("kind", "usual", "most"), [("map", 0.01, 0.06), ("baked", 1e-3, 0.02)])
def test_lower_grad_equals_finite_differences_where_it_is_smooth(fields, kind, usual, most):
    points = draw(-0.8 * HALF, 0.8 * HALF)
    slope = np.asarray(hio.query(fields[kind], points).lower_grad)
    off = np.zeros((COUNT, 3))
    for axis in range(3):
        shift = np.eye(3, dtype=np.float32)[axis] * STEP
        ends = [hio.query(fields[kind], points + sign * shift).lower for sign in (1, -1)]
        middle = hio.query(fields[kind], points).lower
        up, down = np.asarray(ends[0] - middle) / STEP, np.asarray(middle - ends[1]) / STEP
        off[:, axis] = np.abs((up + down) / 2 - slope[:, axis])
        # Kinks, and faces between voxels: there the slopes of both sides differ.
        off[np.abs(up - down) > 0.02, axis] = 0
    assert np.mean(off == 0) < 0.5
    assert np.median(off) < usual and np.quantile(off, 0.9) < most


def test_every_clearance_takes_the_bound(fields):
    field, points = fields["baked"], draw(-0.6 * HALF, 0.6 * HALF)
    lower = {"unknown": "obstacle", "bound": "lower"}
    expected = queries.distance(field, points, **lower) - RADII
    still = planning.swept_clearance(field, points, points, RADII, **lower)
    np.testing.assert_allclose(still, expected, atol=1e-6)
    assert (still <= planning.swept_clearance(field, points, points, RADII) + 1e-6).mean() > 0.99
    spheres = planning.RobotSpheres(jnp.arange(COUNT), jnp.zeros((COUNT, 3)), jnp.asarray(RADII))
    data = planning.BodyPoses(points, np.tile(np.eye(3, dtype=np.float32), (COUNT, 1, 1)))
    clearance = planning.robot_clearance(field, spheres, data, **lower)
    np.testing.assert_allclose(clearance, expected.min(), atol=1e-6)
    path = np.linspace(points[0], points[1], 8)[None]
    given, plain = (
        planning.optimize_trajectory(
            field, path, radius_m=0.05, steps=1, unknown="network", bound=bound
        ).clearance
        for bound in ("lower", "sdf")
    )
    assert given < plain
    for function in (planning.sphere_clearance, planning.sphere_clearance_and_grad):
        with pytest.raises(ValueError, match="bound is 'best', expected 'sdf' or 'lower'"):
            function(field, points, RADII, bound="best")


def test_gradients_of_motions_equal_finite_differences(fields):
    starts, ends = draw(-0.5 * HALF, 0.5 * HALF), draw(-0.5 * HALF, 0.5 * HALF, 1)

    def clearance(starts, ends):
        return planning.swept_clearance(fields["baked"], starts, ends, RADII, bound="lower")

    value, *slopes = planning.swept_clearance_and_grad(
        fields["baked"], starts, ends, RADII, bound="lower"
    )
    np.testing.assert_allclose(value, clearance(starts, ends), atol=1e-6)
    wrong = 0
    for axis in range(3):
        shift = np.eye(3, dtype=np.float32)[axis] * STEP
        by_start = clearance(starts + shift, ends) - clearance(starts - shift, ends)
        by_end = clearance(starts, ends + shift) - clearance(starts, ends - shift)
        for slope, difference in zip(slopes, (by_start, by_end), strict=True):
            wrong += np.abs(difference / (2 * STEP) - slope[:, axis]) > 0.03
    assert np.mean(wrong > 0) < 0.15  # another segment, or another cell


def test_gradients_of_a_robot_equal_finite_differences(fields):
    rng = np.random.default_rng(3)
    spheres = planning.RobotSpheres(
        jnp.asarray([0, 0, 1, 1]),
        jnp.asarray(rng.uniform(-0.1, 0.1, (4, 3)), jnp.float32),
        jnp.full(4, 0.05),
    )
    positions = draw(-0.4 * HALF, 0.4 * HALF)[:40].reshape(20, 2, 3)
    turns = np.tile(np.eye(3, dtype=np.float32), (20, 2, 1, 1))

    def clearance(positions, turns):
        return planning.robot_clearance(
            fields["baked"], spheres, planning.BodyPoses(positions, turns)
        )

    value, by_position, by_rotation = planning.robot_clearance_and_grad(
        fields["baked"], spheres, planning.BodyPoses(positions, turns)
    )
    np.testing.assert_allclose(value, clearance(positions, turns), atol=1e-6)
    wrong = np.zeros(20)
    for body in range(2):
        for axis in range(3):
            step = np.zeros((2, 3), np.float32)
            step[body, axis] = STEP
            slope = (clearance(positions + step, turns) - clearance(positions - step, turns)) / (
                2 * STEP
            )
            wrong += np.abs(slope - by_position[:, body, axis]) > 0.03
            cross = np.zeros((2, 3, 3), np.float32)
            cross[body] = np.cross(np.eye(3)[axis], np.eye(3)).T * STEP
            slope = (clearance(positions, turns + cross) - clearance(positions, turns - cross)) / (
                2 * STEP
            )
            wrong += np.abs(slope - by_rotation[:, body, axis]) > 0.01
    assert np.mean(wrong > 0) < 0.2


@pytest.mark.parametrize("bound", ["sdf", "lower"])
@pytest.mark.parametrize("unknown", ["network", "obstacle"])
def test_outside_a_window_nothing_is_farther_than_the_window_implies(room_map, unknown, bound):
    half = np.array([0.3, 0.3, 0.3])
    window = hio.bake(room_map, 0.1, center=np.zeros(3), size=2 * half)
    assert window.window and not hio.bake(room_map, 0.1).window
    points = draw(-2.0, 2.0)
    nearest = np.clip(points, -half, half).astype(np.float32)
    away = np.linalg.norm(points - nearest, axis=1)
    outside = away > 0
    assert outside.mean() > 0.9
    value, slope = queries.distance_and_grad(window, points, unknown, bound)
    edge = queries.distance(window, nearest, unknown, bound)
    assert (value <= edge - away + 1e-5)[outside].all()
    # It leads back.
    inward = np.sum((nearest - points) * slope, axis=1)[outside]
    assert (inward > 0).all()


def test_the_box_of_a_whole_map_answers_outside_as_the_map_does(fields):
    far = np.array([[3.0, 0.2, 0.1], [0.1, -4.0, 0.3]], np.float32)
    np.testing.assert_allclose(
        hio.sdf(fields["baked"], far), hio.sdf(fields["map"], far), atol=0.05
    )


@pytest.mark.parametrize("radius", [np.nan, -0.1, np.inf])
def test_inside_jit_a_radius_that_is_none_is_in_collision(fields, radius):
    points = draw(-0.3 * HALF, 0.3 * HALF)
    clear = jax.jit(planning.sphere_clearance)
    radii = RADII.copy()
    radii[3] = radius
    value = np.asarray(clear(fields["baked"], points, radii))
    assert value[3] < -1e29
    expected = planning.sphere_clearance(fields["baked"], points, RADII)
    np.testing.assert_allclose(np.delete(value, 3), np.delete(expected, 3), atol=1e-6)
