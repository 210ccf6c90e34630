"""A baked field against the field that it was sampled from."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, HALF

import hiosdf_jax as hio
from hiosdf_jax._src.field import lattice


@pytest.fixture(scope="module")
def field(sharp_map):
    return hio.snapshot(sharp_map, stamp=7.5)


@pytest.fixture(scope="module")
def baked(field):
    return hio.bake(field)


def affine(shape=(9, 8, 7), resolution=0.25):
    """A baked affine function."""
    corner = np.array([-1.0, 0.5, 2.0])
    points = corner + resolution * np.stack(np.indices(shape), axis=-1)
    values = jnp.asarray(points @ [0.5, -1.0, 2.0] + 3, jnp.float32)
    return hio.Baked(
        corner_world=jnp.asarray(corner, jnp.float32),
        resolution=jnp.float32(resolution),
        sdf=values,
        frontier=values - 1,
        lower=values - 2,
        updates=jnp.int32(4),
        stamp=jnp.float32(0),
    )


def test_interpolation_is_exact_for_affine_functions():
    baked = affine()
    low, high = (np.asarray(corner) for corner in lattice.bounds(baked))
    np.testing.assert_allclose(high - low, [2.0, 1.75, 1.5])
    points = np.random.default_rng(0).uniform(low, high, (500, 3))
    points = np.concatenate([points, [low, high]]).astype(np.float32)
    answer = hio.query(baked, points)
    expected = points @ np.array([0.5, -1.0, 2.0]) + 3
    np.testing.assert_allclose(answer.sdf, expected, atol=1e-5)
    np.testing.assert_allclose(answer.frontier, expected - 1, atol=1e-5)
    np.testing.assert_allclose(answer.lower, expected - 2, atol=1e-5)
    inside = np.all((points > low) & (points < high), axis=1)
    np.testing.assert_allclose(answer.grad[inside], [[0.5, -1, 2]] * inside.sum(), atol=1e-4)


def test_interpolation_against_scipy():
    from scipy.interpolate import RegularGridInterpolator

    shape = (6, 7, 5)
    values = np.random.default_rng(1).normal(size=shape)
    baked = affine(shape).replace(sdf=jnp.asarray(values, jnp.float32))
    low, high = (np.asarray(corner) for corner in lattice.bounds(baked))
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, shape, strict=True)]
    points = np.random.default_rng(2).uniform(low, high, (300, 3))
    expected = RegularGridInterpolator(axes, values)(points)
    np.testing.assert_allclose(hio.sdf(baked, points), expected, atol=2e-5)


def test_samples_are_the_fields_answers(field, baked):
    assert baked.sdf.shape == (49, 41, 33)
    index = np.random.default_rng(3).integers(0, baked.sdf.shape, (2000, 3))
    # The samples lie on faces of voxels, where rounding decides in which voxel: the answer is that
    # at the place itself or beside it.
    places = (BOUNDS[0] + 0.05 * index).astype(np.float32)
    beside = 1e-6 * np.array([(0, 0, 0), *itertools.product((-1, 1), repeat=3)], np.float32)
    answer, at = hio.query(field, places + beside[:, None]), tuple(index.T)
    for sampled, asked in ((baked.sdf[at], answer.sdf), (baked.lower[at], answer.lower)):
        error = np.abs(np.asarray(sampled) - asked)
        assert error.min(axis=0).max() < 2e-5
        assert np.mean(error[0] < 1e-5) > 0.95
    assert int(baked.updates) == 48
    assert float(baked.stamp) == 7.5


def test_between_samples_the_error_is_small_and_never_shows_the_unseen(field, baked):
    points = np.random.default_rng(4).uniform(-HALF, HALF, (2000, 3)).astype(np.float32)
    exact, quick = hio.query(field, points), hio.query(baked, points)
    error = np.abs(np.asarray(quick.sdf) - exact.sdf)
    assert np.mean(error < 0.01) > 0.9
    assert not (np.asarray(quick.observed) & (np.asarray(exact.frontier) <= 0)).any()
    assert (np.asarray(quick.frontier) <= np.asarray(exact.frontier) + 1e-4).all()
    assert np.mean(np.asarray(quick.observed) == exact.observed) > 0.8


def test_gradient_is_that_of_the_interpolation(baked):
    points = np.random.default_rng(5).uniform(-1.5, 1.5, (500, 3)).astype(np.float32)
    step = 1e-3
    place = (points - BOUNDS[0]) / 0.05
    off_faces = np.all(np.abs(place - np.round(place)) > 0.05, axis=1)
    off_box = np.all(np.abs(np.abs(points) - np.abs(BOUNDS[1])) > 0.01, axis=1)
    chosen = points[off_faces & off_box]
    assert len(chosen) > 200
    for unknown in ("network", "obstacle"):
        value, gradient = hio.sdf_and_grad(baked, chosen, unknown)
        np.testing.assert_allclose(value, hio.sdf(baked, chosen, unknown), atol=1e-6)
        for axis in range(3):
            shift = np.zeros(3, np.float32)
            shift[axis] = step
            slope = hio.sdf(baked, chosen + shift, unknown) - hio.sdf(
                baked, chosen - shift, unknown
            )
            agree = np.abs(np.asarray(slope) / (2 * step) - gradient[:, axis]) < 5e-3
            assert agree.mean() > (0.999 if unknown == "network" else 0.97)  # not at kinks of min


def test_a_window_moves_without_another_compilation(field):
    traces = []

    @jax.jit
    def clearance(field, center):
        traces.append(1)
        window = hio.bake(field, 0.1, center=center, size=(0.8, 0.8, 0.4))
        assert window.sdf.shape == (9, 9, 5)
        return hio.sdf(window, center)

    for center in np.random.default_rng(6).uniform(-0.3, 0.3, (5, 3)).astype(np.float32):
        assert abs(float(clearance(field, center)) - float(hio.sdf(field, center))) < 0.05
    assert len(traces) == 1


def test_bad_arguments_are_named(field, baked):
    for bad, words in (
        ({"resolution": 0.0}, "resolution is 0.0, expected > 0"),
        ({"center": (0, 0, 0)}, "expected both or neither"),
        ({"center": (0, 0), "size": (1, 1, 1)}, r"center has shape \(2,\), expected \(3,\)"),
        ({"center": (0, 0, 0), "size": (1, 0, 1)}, "size is .*, expected three lengths > 0"),
        ({"resolution": 1e-5}, "which needs .* samples, expected at most"),
    ):
        with pytest.raises(ValueError, match=words):
            hio.bake(field, **bad)
    with pytest.raises(ValueError, match="field is Baked, expected a MapState or a Field"):
        hio.bake(baked)
    with pytest.raises(ValueError, match=r"of shapes \(.*\), \(2, 2, 2\), .*, expected equal ones"):
        hio.sdf(baked.replace(frontier=np.zeros((2, 2, 2))), np.zeros(3))
    with pytest.raises(ValueError, match="expected a MapState, a Field or a Baked"):
        hio.sdf("map", np.zeros(3))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_window_around_no_place_is_refused_or_in_collision(room_map, value):
    center = np.array([value, 0.0, 0.0], np.float32)
    with pytest.raises(ValueError, match=r"center is .*, expected finite coordinates"):
        hio.bake(room_map, 0.2, center=center, size=(1, 1, 1))
    baked = jax.jit(lambda state, c: hio.bake(state, 0.2, center=c, size=(1, 1, 1)))(
        room_map, center
    )
    points = np.array([[0, 0, 0], [0.3, -0.2, 0.1], [5, 5, 5]], np.float32)
    for unknown in ("network", "obstacle"):
        answer = hio.query(baked, points, unknown=unknown)
        assert (np.asarray(answer.sdf) < -1e3).all() and (np.asarray(answer.lower) < -1e3).all()
        assert not np.asarray(answer.observed).any()
