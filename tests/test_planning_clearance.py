"""Clearances of spheres, at rest and in motion, and their cost, against plain geometry."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import baked
from hypothesis import given, settings
from hypothesis import strategies as st

import hiosdf_jax as hio
from hiosdf_jax import planning

COUNT = 40  # spheres in nearly every test, so that they share compilations
RESOLUTION = 0.05
LOW, HIGH = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
clearance = partial(planning.sphere_clearance, unknown="network")
swept_clearance = partial(planning.swept_clearance, unknown="network")
CLEARANCE = jax.jit(clearance)
SWEPT = jax.jit(swept_clearance, static_argnames="evaluations")
SLOPES = jax.jit(jax.grad(lambda *arguments: SWEPT(*arguments).sum(), (1, 2)))
BOXES = [  # center, half sizes; m
    (np.array([0.3, 0.2, 0.4]), np.array([0.2, 0.1, 0.4])),
    (np.array([-0.5, -0.4, 0.3]), np.array([0.1, 0.3, 0.1])),
]


def box_distance(points, center, half):
    beyond = np.abs(np.asarray(points, float) - center) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def scene_distance(points):
    return np.min([box_distance(points, *box) for box in BOXES], axis=0)


@pytest.fixture(scope="module")
def scene():
    return baked(scene_distance, LOW, HIGH, RESOLUTION)


@pytest.fixture(scope="module")
def field():
    config = hio.Config.light((LOW, HIGH), hidden_width=16, max_points=64)
    return hio.snapshot(hio.init(config, jax.random.key(1)))


def steepest(baked):
    """Bound of a trilinear function's slope: the root of the squares of its steepest edges."""
    values = np.asarray(baked.sdf, float)
    slopes = [np.abs(np.diff(values, axis=k)).max() / RESOLUTION for k in range(3)]
    return float(np.linalg.norm(slopes))


def spheres(count, seed=0, margin=0.2):
    rng = np.random.default_rng(seed)
    centers = rng.uniform(LOW - margin, HIGH + margin, (count, 3)).astype(np.float32)
    return centers, rng.uniform(0, 0.2, count).astype(np.float32)


def test_clearance_is_the_distance_minus_the_radius(scene):
    centers, radii = spheres(500, margin=-0.05)
    found = clearance(scene, centers, radii)
    assert found.shape == (500,)
    # Interpolation between samples of a distance errs by less than half a cell's diagonal.
    exact = scene_distance(centers) - radii
    assert np.abs(found - exact).max() < RESOLUTION
    assert np.median(np.abs(found - exact)) < 0.002


def test_batches_equal_single_spheres_and_gradients_finite_differences(scene, field):
    centers, radii = spheres(12)
    alone = jax.jit(partial(planning.sphere_clearance_and_grad, unknown="network"))
    for answering in (scene, field):
        value, gradient = alone(answering, centers.reshape(3, 4, 3), radii.reshape(3, 4))
        assert value.shape == (3, 4)
        for k in range(12):
            one_value, one_gradient = alone(answering, centers[k], radii[k])
            np.testing.assert_allclose(one_value, value.ravel()[k], atol=1e-5)
            np.testing.assert_allclose(one_gradient, gradient.reshape(12, 3)[k], atol=1e-4)
        step = 1e-3
        for axis in range(3):
            shift = np.eye(3, dtype=np.float32)[axis] * step
            up, down = (CLEARANCE(answering, centers + sign * shift, radii) for sign in (1, -1))
            error = np.abs((up - down) / (2 * step) - gradient.reshape(12, 3)[:, axis])
            assert np.sort(error)[-2] < 5e-3  # a step may cross a cell boundary


@settings(max_examples=10, deadline=None)
@given(st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_a_scene_moved_with_its_spheres_has_the_same_clearances(scene, shift):
    shift = np.round(np.array(shift) * 16) / 16
    centers, radii = spheres(COUNT, margin=0.1)
    there = scene.replace(corner_world=scene.corner_world + jnp.asarray(shift, jnp.float32))
    moved = (centers + shift).astype(np.float32)
    np.testing.assert_allclose(
        CLEARANCE(there, moved, radii), CLEARANCE(scene, centers, radii), atol=5e-5
    )
    np.testing.assert_allclose(
        SWEPT(there, moved, moved + 0.25, radii),
        SWEPT(scene, centers, centers + 0.25, radii),
        atol=5e-5,
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([2, 6, 9]), st.floats(0.01, 1.5))
def test_swept_clearance_is_at_most_that_of_any_pose_between(scene, seed, evaluations, length):
    rng = np.random.default_rng(seed)
    starts, radii = spheres(COUNT, seed)
    way = rng.normal(size=(COUNT, 3))
    ends = (starts + length * way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)
    swept = SWEPT(scene, starts, ends, radii, slope=steepest(scene), evaluations=evaluations)
    between = np.linspace(0, 1, 301)[:, None, None]
    poses = (starts + between * (ends - starts)).astype(np.float32)
    least = np.asarray(CLEARANCE(scene, poses, radii)).min(axis=0)
    assert (swept <= least + 1e-5).all()


def test_swept_clearance_does_not_tunnel_and_is_tight_near_surfaces():
    # A sheet so thin that 9 poses along the motion miss it.
    sheet = (np.array([0.0, 0.0, 0.5]), np.array([0.01, 0.8, 0.4]))
    scene = baked(lambda p: box_distance(p, *sheet), LOW, HIGH, RESOLUTION)
    start = np.tile(np.float32([-0.93, 0.1, 0.5]), (COUNT, 1))
    end = np.tile(np.float32([0.88, 0.13, 0.52]), (COUNT, 1))
    nothing = np.zeros(COUNT, np.float32)
    poses = start[0] + np.linspace(0, 1, 9)[:, None] * (end[0] - start[0])
    assert clearance(scene, poses, 0.0).min() > 0.01
    assert SWEPT(scene, start, end, nothing)[0] <= -0.01 + 1e-6
    # Past the sheet's edge the least clearance is 3 cm, in one place.
    start, end = np.float32([-0.5, 0.85, 0.5]), np.float32([0.5, 0.85, 0.5])
    swept = [float(SWEPT(scene, start, end, 0.02, slope=1.0, evaluations=n)) for n in (2, 9, 33)]
    assert swept == sorted(swept)
    assert swept[0] < 0.0
    assert 0.025 < swept[-1] <= 0.03 + 1e-6


def test_swept_clearance_at_rest_is_the_clearance(scene):
    centers, radii = spheres(COUNT)
    still = SWEPT(scene, centers, centers, radii)
    np.testing.assert_allclose(still, CLEARANCE(scene, centers, radii), atol=1e-6)
    assert np.isfinite(SLOPES(scene, centers, centers, radii)).all()


def test_swept_clearance_under_vmap_and_its_gradient(scene, field):
    starts, radii = spheres(COUNT, margin=-0.05)
    way = np.float32([0.31, -0.17, 0.12])
    arguments = [starts, starts + way, radii]
    mapped = jax.jit(jax.vmap(swept_clearance, (None, 0, 0, 0)))
    for answering in (scene, field):
        expected = SWEPT(answering, *arguments)
        np.testing.assert_allclose(mapped(answering, *arguments), expected, atol=1e-5)
        gradients = SLOPES(answering, *arguments)
        step = 5e-4
        for argument, axis in ((0, 0), (1, 2)):
            shift = np.zeros((2, 3), np.float32)
            shift[argument, axis] = step
            up, down = (
                SWEPT(answering, starts + sign * shift[0], starts + way + sign * shift[1], radii)
                for sign in (1, -1)
            )
            error = np.abs((up - down) / (2 * step) - gradients[argument][:, axis])
            assert np.quantile(error, 0.85) < 5e-3  # the others have a kink within the step
            assert np.abs(gradients[argument][:, axis]).max() > 0.1


def test_swept_clearance_is_the_same_outside_jit(scene):
    starts, radii = spheres(COUNT)
    np.testing.assert_allclose(
        swept_clearance(scene, starts, -starts, radii),
        SWEPT(scene, starts, -starts, radii),
        atol=1e-5,
    )


def test_unseen_space_is_solid_by_default(scene):
    half_seen = scene.replace(frontier=jnp.full_like(scene.sdf, 0.05))
    centers, radii = np.array([[-0.7, 0.7, 0.8]], np.float32), 0.1
    assert clearance(half_seen, centers, radii)[0] > 0.3
    for answer in (
        planning.sphere_clearance(half_seen, centers, radii),
        planning.swept_clearance(half_seen, centers, centers, radii),
    ):
        np.testing.assert_allclose(answer, [-0.05], atol=1e-6)


def test_a_map_is_a_traced_argument_of_a_sweep(scene):
    traces = []

    @jax.jit
    def cost(baked, starts, ends):
        traces.append(1)
        return planning.collision_cost(
            planning.swept_clearance(baked, starts, ends, 0.1), 0.2
        ).sum()

    starts, _ = spheres(5)
    costs = {
        float(cost(scene.replace(sdf=scene.sdf - lift), starts, starts + 0.1))
        for lift in (0.0, 0.1, 0.2)
    }
    assert len(costs) == 3
    assert len(traces) == 1


def test_far_points_give_finite_answers(scene):
    far = np.zeros((COUNT, 3), np.float32)
    far[:3] = [[np.inf, 0, -np.inf], [1e30, 0, 0], [3e38, 3e38, -3e38]]
    radii = np.full(COUNT, 0.1, np.float32)
    assert np.isfinite(CLEARANCE(scene, far, radii)).all()
    for ends in (far, far[::-1]):
        assert np.isfinite(SWEPT(scene, far, ends, radii)).all()
        slopes = SLOPES(scene, far, ends, radii)
        assert np.isfinite(slopes).all()


def test_collision_cost_equals_chomps():
    margin = 0.3
    clearance = np.array([-2.0, -0.1, 0.0, 0.1, 0.3, 0.31, 5.0, np.inf])
    expected = [2.15, 0.25, 0.15, 0.2**2 / 0.6, 0, 0, 0, 0]
    np.testing.assert_allclose(planning.collision_cost(clearance, margin), expected, atol=1e-6)
    slopes = jax.vmap(jax.grad(lambda d: planning.collision_cost(d, margin)))(clearance)
    np.testing.assert_allclose(slopes, [-1, -1, -1, -2 / 3, 0, 0, 0, 0], atol=1e-6)
    # Traced margins, one per clearance.
    margins = jax.jit(planning.collision_cost)(jnp.zeros(3), jnp.array([0.1, 0.2, 0.4]))
    np.testing.assert_allclose(margins, [0.05, 0.1, 0.2], atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"radii": -0.1}, r"radii.*-0\.1"),
        ({"radii": [0.1, -0.2, np.nan]}, r"radii has 2 .*-0\.2, nan\] at \[\[1\], \[2\]\]"),
        ({"radii": np.zeros(4)}, r"radii has shape \(4,\), expected .* \(3,\)"),
        ({"radii": np.zeros((2, 3))}, r"radii has shape \(2, 3\)"),
        ({"start_world": np.zeros((3, 2)), "end_world": np.zeros((3, 2))}, "start_world"),
        ({"end_world": np.zeros((2, 3))}, r"end_world has shape \(2, 3\)"),
        ({"evaluations": 1}, "evaluations is 1"),
        ({"evaluations": 2.5}, "evaluations is 2.5"),
        ({"evaluations": 10**12}, "evaluations is 1000000000000, expected at most 10000"),
        ({"evaluations": 10**30}, "evaluations is 1000"),
        ({"slope": 0.0}, "slope is 0.0"),
        ({"slope": float("nan")}, "slope is nan"),
        ({"unknown": "free"}, "unknown is 'free'"),
    ],
)
def test_bad_arguments_of_a_sweep_are_refused(scene, arguments, words):
    good = {"start_world": np.zeros((3, 3)), "end_world": np.ones((3, 3)), "radii": 0.1}
    with pytest.raises(ValueError, match=words):
        planning.swept_clearance(scene, **(good | arguments))


def test_bad_arguments_of_clearances_and_costs_are_refused(scene):
    for function in (planning.sphere_clearance, planning.sphere_clearance_and_grad):
        with pytest.raises(ValueError, match=r"radii.*-1"):
            function(scene, np.zeros((2, 3)), [0, -1])
        with pytest.raises(ValueError, match=r"centers_world has shape \(2,\)"):
            function(scene, np.zeros(2), 0.1)
    with pytest.raises(ValueError, match="field is dict"):
        planning.sphere_clearance({}, np.zeros(3), 0.1)
    for margin in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="margin_m"):
            planning.collision_cost(0.1, margin)
    for cost in (planning.collision_cost, jax.jit(planning.collision_cost)):
        with pytest.raises(ValueError, match=r"margin_m has shape \(4,\), .* \(3,\)"):
            cost(np.zeros(3), np.ones(4))
