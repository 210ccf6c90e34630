"""Where a cloud is in a map, without a guess: found, and ambiguous where the world is."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from poses import random_pose
from room import BOUNDS, HALF, room_cloud
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.field.lattice import sample_counts
from hiosdf_jax._src.mapping.registration.refining import Registration
from hiosdf_jax._src.mapping.registration.relocalizing import (
    _ROUNDS,
    Relocalization,
    _Cells,
    _copy,
    _hypotheses_for,
    _look_up,
    _turn_onto,
    _Upright,
)

RESOLUTION = 0.05
COUNT = 700
HYPOTHESES = 2048

# A cupboard that makes the four corners of the room differ.
CUPBOARD = np.array([0.75, 0.5, 0.0]), np.array([0.22, 0.28, 0.56])


def room_distance(points):
    return (HALF - np.abs(points)).min(axis=-1)


def furnished_distance(points):
    middle, half = CUPBOARD
    outside = np.abs(points - middle) - half
    box = np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)
    return np.minimum(room_distance(points), box)


def baked(distance):
    """Samples as `bake` makes of a map of the room: `refine_pose` is compiled once for both."""
    corner = np.array(BOUNDS[0])
    shape = sample_counts(np.array(BOUNDS[1]) - corner, RESOLUTION)
    values = distance(corner + RESOLUTION * np.moveaxis(np.indices(shape), 0, -1))
    return hio.Baked(
        corner_world=jnp.asarray(corner, jnp.float32),
        resolution=jnp.float32(RESOLUTION),
        sdf=jnp.asarray(values, jnp.float32),
        frontier=jnp.where(values > -0.1, 1.0, -1.0).astype(jnp.float32),
        lower=jnp.asarray(values, jnp.float32),
        updates=jnp.int32(10),
        stamp=jnp.float32(0),
    )


def view(seed):
    """Exact returns in the furnished room, by sphere tracing, and the sensor's pose."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    pose[:3, 3] = rng.uniform(-0.4, 0.2, 3) * [1, 1, 0.5]
    rays = rng.normal(size=(COUNT, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    reach = np.zeros((COUNT, 1))
    for _ in range(200):
        world = (reach * rays) @ pose[:3, :3].T + pose[:3, 3]
        reach += np.maximum(furnished_distance(world), 0)[:, None]
    return (reach * rays).astype(np.float32), pose


def away(pose, exact):
    """Meters and radians between two poses."""
    turn = Rotation.from_matrix(np.asarray(pose, float)[:3, :3] @ exact[:3, :3].T)
    return np.linalg.norm(np.asarray(pose)[:3, 3] - exact[:3, 3]), turn.magnitude()


@pytest.mark.parametrize("seed", range(3))
def test_the_place_is_found(seed):
    cloud, pose = view(seed)
    found = hio.relocalize(baked(furnished_distance), cloud, jax.random.key(seed), HYPOTHESES)
    way, turn = away(found.best.pose, pose)
    assert way < 0.01
    assert turn < 0.01
    assert bool(found.best.converged)
    assert float(found.score) > 0.95
    assert float(found.other_score) < float(found.score) - 0.03
    assert bool(found.sure) == (float(found.other_score) < float(found.score) - 0.1)


def test_rows_that_are_no_returns_change_nothing():
    """A depth camera without an answer gives zeros."""
    cloud, _ = view(0)
    field, key = baked(furnished_distance), jax.random.key(0)
    expected = hio.relocalize(field, cloud, key, HYPOTHESES)
    more = np.zeros((2 * COUNT, 3), np.float32)
    more[1::2] = cloud
    more[::4] = [1e7, np.nan, 0]
    found = hio.relocalize(field, more, key, HYPOTHESES)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_inside_jit_a_cloud_may_have_no_rows():
    field, none = baked(furnished_distance), np.zeros((0, 3), np.float32)
    found = jax.eval_shape(lambda cloud: hio.relocalize(field, cloud, jax.random.key(0), 256), none)
    assert found.best.pose.shape == (4, 4)


def test_a_symmetric_room_has_two_answers():
    cloud, pose = room_cloud(3, COUNT, 0.4, (0.2, 0.1, 0.05))
    found = hio.relocalize(baked(room_distance), cloud, jax.random.key(0), HYPOTHESES)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    errors = [
        min(away(each.pose, p)[0] for p in (pose, half_turn @ pose))
        for each in (found.best, found.other)
    ]
    assert max(errors) < 0.01
    assert abs(float(found.score) - float(found.other_score)) < 0.02
    assert not bool(found.sure)
    way, turn = away(found.best.pose, np.asarray(found.other.pose, float))
    assert way > 0.4
    assert turn > 3


def test_a_sensor_that_is_mounted_askew():
    """The cloud of a tilted sensor, in a map whose up is another axis."""
    cloud, pose = view(1)
    mounted = Rotation.from_rotvec([0.7, -1.1, 0.3]).as_matrix()
    found = hio.relocalize(
        baked(furnished_distance),
        cloud @ mounted,
        jax.random.key(1),
        HYPOTHESES,
        up_sensor=mounted.T @ [0, 0, 2e-30],  # any length
    )
    expected = pose.copy()
    expected[:3, :3] = pose[:3, :3] @ mounted
    way, turn = away(found.best.pose, expected)
    assert way < 0.01
    assert turn < 0.01


@pytest.mark.parametrize("end", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, -0.48, -0.64]])
def test_a_direction_is_turned_onto_another(end):
    turn = np.asarray(_turn_onto(jnp.asarray([0.0, 0, 1]), jnp.asarray(end, jnp.float32)))
    np.testing.assert_allclose(turn @ [0, 0, 1], end, atol=1e-5)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(turn) > 0


@pytest.mark.parametrize("seed", range(3))
def test_the_costs_of_returns_are_those_of_their_cells(seed):
    """Against numpy in float64; returns on the border between cells may be on either side."""
    rng = np.random.default_rng(seed)
    shape, corner, size = (5, 7, 4), np.array([-1.0, 0.5, -2.0]), 0.4
    costs = rng.uniform(size=shape).astype(np.float32)
    pose = random_pose(rng)
    pose[:3, 3] = corner + 0.5 * size * np.array(shape)
    points = rng.uniform(-1.5, 1.5, (500, 3))
    points[0] = 1e9  # no int32 holds its cell
    cell = (points @ pose[:3, :3].T + pose[:3, 3] - corner) / size
    index = np.floor(cell).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    expected = np.where(inside, costs[tuple(np.where(inside[:, None], index, 0).T)], 1)
    clear = (np.abs(cell - np.round(cell)) > 1e-4).all(axis=1)
    cells = _Cells(
        jnp.asarray(corner, jnp.float32), size, jnp.asarray(costs), jnp.ones(shape, bool)
    )
    arguments = (jnp.asarray(each, jnp.float32) for each in (pose, points))
    found = np.asarray(_look_up(cells, jnp.asarray(costs), *arguments))
    assert 50 < inside.sum() < 450
    np.testing.assert_array_equal(found[clear], expected[clear])


def test_one_copy_of_each_hypothesis_stays():
    """So a round never makes a hypothesis worse."""
    tried = _Upright(jnp.arange(12.0).reshape(4, 3), jnp.arange(4.0))
    copies = jax.jit(_copy, static_argnums=1)(tried, _ROUNDS[0], jax.random.key(0))
    for part, moved in zip(tried, copies, strict=True):
        np.testing.assert_array_equal(moved[:, 0], part)
        assert len(np.unique(moved[0].reshape(-1, *np.shape(part[0])), axis=0)) == moved.shape[1]


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((20, 20, 20), 65_536), ((100, 100, 100), 250_000), ((400, 500, 100), 4_194_304)],
)
def test_large_maps_get_more_hypotheses(shape, expected):
    config = SimpleNamespace(grid_shape=shape)
    assert _hypotheses_for(SimpleNamespace(config=config)) == expected


def test_an_empty_map_knows_no_place(empty_map):
    cloud, _ = view(0)
    found = hio.relocalize(empty_map, cloud, jax.random.key(0), HYPOTHESES)
    assert not bool(found.best.converged)
    assert float(found.score) == 0
    assert not bool(found.sure)
    assert np.isfinite(np.asarray(found.best.pose)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"field": 3}, "field is int"),
        ({"cloud": np.zeros((5, 2))}, r"cloud has shape \(5, 2\)"),
        ({"cloud": np.full((5, 3), np.nan)}, "cloud has no finite row"),
        ({"key": 3}, "key has dtype"),
        ({"hypotheses": 10}, "hypotheses is 10, expected a whole number >= 256"),
        ({"up_sensor": (0, 0)}, r"up_sensor has shape \(2,\), expected \(3,\)"),
        ({"up_world": (0, 0, 0)}, r"up_world is \(0, 0, 0\), expected a direction"),
    ],
)
def test_wrong_input_is_named(empty_map, change, message):
    arguments = {"field": empty_map, "cloud": view(0)[0], "key": jax.random.key(0)}
    with pytest.raises(ValueError, match=message):
        hio.relocalize(**arguments | change)


@pytest.mark.parametrize(
    ("converged", "score", "other_score", "sure"),
    [(True, 0.8, 0.6, True), (True, 0.8, 0.75, False), (False, 0.9, 0.1, False)],
)
def test_a_place_is_sure_if_it_has_converged_and_fits_clearly_better(
    converged, score, other_score, sure
):
    zero = jnp.float32(0)
    best = Registration(jnp.eye(4), jnp.eye(6), zero, zero, jnp.asarray(converged))
    place = Relocalization(best, jnp.float32(score), best, jnp.float32(other_score))
    assert bool(place.sure) == sure
