"""The weights of returns, in a complete map and in one that grows, and the steps from them."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import clear, interpret_point_kernels
from room import CONFIG, HALF, room_cloud
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.registration import comparing, equations, solving
from hiosdf_jax._src.mapping.registration.comparing import compare, make_rows
from hiosdf_jax._src.state.pytrees import field_of

COUNT = 1000
SHEET_CONFIG = dataclasses.replace(CONFIG, max_points=COUNT)


@partial(jax.jit, static_argnames="scale_m")
def compared(field, cloud, pose, growing, scale_m=0.0):
    some = jnp.ones(len(cloud), bool)
    noise = jnp.float32(0.01), jnp.float32(0)
    return compare(field, make_rows(cloud, some, noise, growing), pose, scale_m)


def returns():
    """A cloud, and a pose that is 3 cm off along each axis."""
    cloud, pose = room_cloud(70, COUNT)
    pose = np.array(pose)
    pose[:3, 3] += 0.03
    return cloud, pose


@pytest.mark.parametrize(("growing", "deviations"), [(0.0, 3.0), (0.5, 2.25), (1.0, 1.5)])
def test_weights_are_those_of_geman_and_mcclure(sharp_map, growing, deviations):
    found = compared(field_of(sharp_map), *returns(), growing)
    distance, sigma = (np.asarray(part, float) for part in (found.distance, found.sigma))
    expected = 1 / (sigma * (1 + (distance / (deviations * sigma)) ** 2)) ** 2
    some = np.asarray(found.comparable)
    assert some.mean() > 0.3
    np.testing.assert_allclose(found.weight[some], expected[some], rtol=1e-4)
    np.testing.assert_array_equal(found.weight[~some], 0)


def test_fewer_returns_are_compared_in_a_map_that_grows(sharp_map):
    complete, grows = (compared(field_of(sharp_map), *returns(), each) for each in (0.0, 1.0))
    fewer = np.asarray(complete.comparable) & ~np.asarray(grows.comparable)
    assert not np.any(np.asarray(grows.comparable) & ~np.asarray(complete.comparable))
    assert np.asarray(grows.comparable).mean() > 0.3
    assert fewer.any()


def test_a_return_as_far_as_the_scale_keeps_the_same_weight(sharp_map):
    """Coarse steps tolerate what the scale says, however complete the map is."""
    complete, grows = (
        compared(field_of(sharp_map), *returns(), each, scale_m=0.5) for each in (0.0, 1.0)
    )
    both = np.asarray(complete.comparable & grows.comparable)
    ratio = [np.asarray(each.weight * each.sigma**2)[both] for each in (complete, grows)]
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=0.01)


@pytest.mark.parametrize("growing", [0.0, 1.0])
@pytest.mark.parametrize("scale_m", [0.1, comparing.GROWING_REACH_M])
def test_a_tolerance_can_be_added_later(sharp_map, growing, scale_m):
    field, (cloud, pose) = field_of(sharp_map), returns()
    rows = make_rows(jnp.asarray(cloud), jnp.ones(COUNT, bool), (0.01, 0.0), growing)
    later = comparing.tolerate(compared(field, cloud, pose, growing), rows, scale_m)
    expected = compared(field, cloud, pose, growing, scale_m=scale_m)
    assert float(jnp.mean(later.comparable)) > 0.3
    for name, one, other in zip(later._fields, later, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("count", [COUNT, 5000])  # fewer and more than fine steps use
def test_the_share_of_selected_returns_is_that_of_a_comparison(sharp_map, count, monkeypatch):
    def mean_width(width, count):
        return width / jnp.maximum(count, 1)  # the share is limited to 1 here

    monkeypatch.setattr(solving, "share_of_map", mean_width)
    monkeypatch.setattr(comparing, "share_of_map", mean_width)
    field, (cloud, pose) = field_of(sharp_map), room_cloud(70, count)
    rows = make_rows(jnp.asarray(cloud), jnp.ones(count, bool), (0.01, 0.0))

    def shares():
        selected = solving.select_rows(field, rows, jnp.asarray(pose))
        measured = comparing.measure_share(field, selected.rows, jnp.asarray(pose))
        return selected.rows.share, measured.share

    found, expected = jax.jit(shares)()
    assert float(found) > 0
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def on_wall():
    """Returns on the wall at x = HALF[0], not near its edges, world frame."""
    rng = np.random.default_rng(0)
    across = rng.uniform(-0.7, 0.7, (COUNT, 2)) * HALF[1:]
    return np.column_stack([np.full(COUNT, HALF[0]), across]).astype(np.float32)


def seen_from(field, points_world, position_world):
    """The share of returns that are compared, for a sensor at a position without a turn."""
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = position_world
    cloud = points_world - pose[:3, 3]
    return float(np.mean(compared(field, cloud, pose, 0.0).comparable))


@pytest.mark.parametrize("way_m", [-0.02, 0.0, 0.02, 0.06])
def test_a_wall_that_was_seen_from_inside_holds_no_returns_from_outside(sharp_map, way_m):
    field = field_of(sharp_map)
    ends = on_wall() + np.float32([way_m, 0, 0])
    assert seen_from(field, ends, [0, 0, 0]) > 0.8
    assert seen_from(field, ends, [HALF[0] + 2, 0, 0]) < 0.02


def map_of_a_sheet():
    """A map of a sheet seen from both sides, the sensor's positions there, and the sheet."""
    rng = np.random.default_rng(0)
    sheet = np.full((COUNT, 3), 0.03, np.float32)  # not on faces of voxels
    sheet[:, 1:] = rng.uniform(-0.5, 0.5, (COUNT, 2))
    state = hio.init(SHEET_CONFIG, jax.random.key(0))
    sides = np.float32([[0.9, 0, 0], [-0.9, 0, 0]])
    for number in range(6):
        pose = np.eye(4, dtype=np.float32)
        pose[:3, 3] = sides[number % 2]
        state = hio.update(state, sheet - pose[:3, 3], pose)
    return field_of(state), sides, sheet


def test_a_sheet_whose_sides_are_free_holds_returns_from_both():
    field, sides, sheet = map_of_a_sheet()
    for side in sides:
        for way_m in (-0.01, 0.0, 0.01):
            ends = np.float32([1, 0.8, 0.8]) * sheet + np.float32([way_m, 0, 0])
            assert seen_from(field, ends, side) > 0.8


def test_returns_from_the_other_side_of_a_sheet_are_off_by_its_thickness():
    field, sides, sheet = map_of_a_sheet()
    ends = np.float32([1, 0.8, 0.8]) * sheet
    found = []
    for side in sides:
        pose = np.eye(4, dtype=np.float32)
        pose[:3, 3] = side
        found.append(compared(field, ends - side, pose, 0.0))
    both = np.asarray(found[0].comparable & found[1].comparable)
    one, other = (np.asarray(each.sigma, float)[both] ** 2 for each in found)
    # A patch has one front. The sensors see each return from about the same range and angle.
    thickness = CONFIG.voxel_size**2 / 12
    np.testing.assert_allclose(np.abs(one - other), thickness, rtol=0.01)


def test_a_map_that_grows_holds_no_returns_from_the_other_side_of_a_sheet():
    field, sides, sheet = map_of_a_sheet()
    ends = np.float32([1, 0.8, 0.8]) * sheet
    shares = []
    for growing in (0.0, 1.0):
        found = []
        for side in sides:
            pose = np.eye(4, dtype=np.float32)
            pose[:3, 3] = side
            found.append(np.asarray(compared(field, ends - side, pose, growing).comparable))
        shares.append((np.mean(found[0] | found[1]), np.mean(found[0] & found[1])))
    complete, grows = np.array(shares)
    assert complete.min() > 0.7
    assert grows[0] > 0.5
    assert grows[1] == 0


@pytest.mark.parametrize("with_prior", [False, True])
def test_without_directions_a_step_is_that_along_the_axes(with_prior):
    rng = np.random.default_rng(0)
    rows = comparing.make_rows(jnp.ones((50, 3)), jnp.ones(50, bool), (0.01, 0.001))
    flags = jnp.ones(50, bool)
    residuals = comparing.Residuals(
        distance=jnp.float32(rng.normal(size=50)),
        jacobian=jnp.float32(rng.normal(size=(50, 6))),
        sigma=jnp.ones(50),
        comparable=flags,
        contrary=~flags,
        weight=jnp.float32(rng.uniform(0.5, 2, 50)),
        points_world=jnp.ones((50, 3)),
        width=jnp.zeros(50),
    )
    away = jnp.eye(4).at[0, 3].set(0.1)
    anchor = equations.Anchor(away, 3 * jnp.eye(6) if with_prior else None)
    axes = equations.Directions(jnp.eye(6), jnp.zeros(6, bool))
    found, expected = (
        equations.find_step(
            comparing.sums_of(residuals), directions, anchor, rows, jnp.eye(4), 2.0, 1e-3
        )
        for directions in (None, axes)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)
    normal = np.asarray(residuals.jacobian, float).T * np.asarray(residuals.weight, float) / 2
    information = normal @ np.asarray(residuals.jacobian, float)
    slope = normal @ np.asarray(residuals.distance, float)
    information += 1e-3 * np.trace(information) / 6 * np.eye(6)
    if with_prior:
        information += 3 * np.eye(6)
        slope += 3 * np.array([-0.1, 0, 0, 0, 0, 0])
    wanted = -np.linalg.solve(information, slope) / np.asarray(comparing.units(rows))
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)


def random_problem(seed, free):
    """Returns the sums of random returns, directions, some of them free, a prior, and a pose."""
    rng = np.random.default_rng(seed)

    def pose(size):
        result = np.eye(4)
        turn = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
        result[:3] = np.column_stack([turn, size * rng.normal(size=3)])
        return jnp.float32(result)

    slopes, root = rng.normal(size=(30, 6)), 30 * rng.normal(size=(6, 6))
    lower = (slopes.T @ slopes)[tuple(np.transpose(comparing.LOWER))]
    values = 1e4 * np.concatenate([lower, rng.normal(size=6) / 30, np.ones(4)])
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    directions = equations.Directions(jnp.float32(basis), jnp.arange(6) < free)
    anchor = equations.Anchor(pose(0.1), jnp.float32(root @ root.T))
    return comparing.Sums(jnp.float32(values)), directions, anchor, pose(0.1)


def test_a_step_with_directions_solves_the_equations_in_float64():
    """Two directions are free: the returns tell nothing there, and the prior decides."""
    sums, directions, anchor, pose = random_problem(5, free=2)
    rows = comparing.make_rows(jnp.ones((9, 3)), jnp.ones(9, bool), (0.01, 0.001))
    found = equations.find_step(sums, directions, anchor, rows, pose, 2.0)
    basis, bound = np.asarray(directions.basis, float), np.arange(6) >= 2
    information = np.zeros((6, 6))
    for (i, j), value in zip(comparing.LOWER, np.asarray(sums.information, float), strict=True):
        information[i, j] = information[j, i] = value / 2
    projector = basis[:, bound] @ basis[:, bound].T
    units = np.asarray(comparing.units(rows), float)
    first, second = np.asarray(anchor.pose, float), np.asarray(pose, float)
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    away = units * np.concatenate([second[:3, 3] - first[:3, 3], turn])
    prior = np.asarray(anchor.information, float)
    matrix = projector @ information @ projector + prior
    slope = projector @ np.asarray(sums.slope, float) / 2 + prior @ away
    np.testing.assert_allclose(found, -np.linalg.solve(matrix, slope) / units, rtol=2e-3, atol=1e-6)


def test_the_kernel_of_a_gpu_sums_what_arrays_sum(sharp_map, monkeypatch):
    """The kernel is interpreted, for a few hundred returns of two poses."""
    field, (cloud, pose) = field_of(sharp_map), returns()
    rows = make_rows(cloud[:300], jnp.arange(300) % 7 > 0, (0.01, 0.001), 0.3)
    rows = rows._replace(share=jnp.float32(0.6))
    poses = jnp.stack([jnp.asarray(pose), jnp.asarray(pose).at[:3, 3].add(0.2)])

    def sums(poses):
        each = jax.vmap(lambda pose: comparing.sum_returns(field, rows, pose, 0.1).values)
        return np.asarray(jax.jit(each)(poses))

    expected = sums(poses)
    interpret_point_kernels(monkeypatch)
    found = sums(poses)
    clear()
    assert (expected[:, 28] > 50).all()  # the map tells something of that many returns
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
