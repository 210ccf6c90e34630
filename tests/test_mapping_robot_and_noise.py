"""Optional arguments of an update: the robot's spheres and the noise of the sensor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, arrays_equal, distances, room_cloud

import hiosdf_jax as hio
from hiosdf_jax._src.grid import rays
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.numerics import robot_and_noise

CENTERS = np.array([[0.3, 0.05, 0.0], [0.42, 0.05, 0.05]], np.float32)  # m, world
RADII = np.array([0.06, 0.05], np.float32)
AWAY = (CENTERS + 50, RADII)
NO_FLAG = jnp.uint32(0)


def update(state, cloud, pose, robot=AWAY, noise=CONFIG.range_noise):
    """An update with both arguments: one compilation for all tests."""
    return hio.update(state, cloud, pose, robot=robot, noise=noise)


def cloud_with_an_arm():
    """Returns a cloud of the room, the same with rays that end on the arm, and their mask."""
    cloud, pose = room_cloud(0)
    on_arm = np.zeros(len(cloud), bool)
    on_arm[:40] = True
    rng = np.random.default_rng(1)
    offsets = rng.normal(size=(40, 3))
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
    sphere = rng.integers(2, size=40)
    # On the spheres, up to 2 cm outside.
    reach = RADII[sphere, None] + rng.uniform(0, 0.02, (40, 1))
    world = CENTERS[sphere] + reach * offsets
    covered = cloud.copy()
    covered[on_arm] = (world - pose[:3, 3]) @ pose[:3, :3]
    return cloud, covered.astype(np.float32), on_arm, pose


def test_returns_on_the_robot_change_nothing(empty_map):
    _, covered, on_arm, pose = cloud_with_an_arm()
    without = np.where(on_arm[:, None], np.nan, covered)
    expected = update(empty_map, without, pose)
    actual = update(empty_map, covered, pose, (CENTERS, RADII))
    for part in ("grid", "network", "optimism"):
        assert arrays_equal(getattr(actual, part), getattr(expected, part)), part
    # Without a robot, and with a robot alone.
    plain = hio.update(empty_map, without, pose)
    assert arrays_equal(actual.grid, plain.grid)
    alone = hio.update(empty_map, covered, pose, robot=(CENTERS, RADII))
    for part in ("grid", "network", "optimism"):
        assert arrays_equal(getattr(alone, part), getattr(plain, part)), part
    assert int(actual.report.points_used) == int(expected.report.points_used)
    assert int(actual.report.points_out_of_range) == 0  # the arm's returns are in range
    ghost = hio.update(empty_map, covered, pose)
    assert float(hio.sdf(ghost, CENTERS[0])) < 0.1 < float(hio.sdf(actual, CENTERS[0]))


def test_an_arm_that_was_mapped_before_its_pose_was_known_is_removed(empty_map):
    cloud, covered, _, pose = cloud_with_an_arm()
    ghost = hio.update(empty_map, covered, pose)
    cleared = update(ghost, cloud, pose, (CENTERS, RADII + 0.02))
    hits, mean = (
        np.asarray(x, float) for x in (ghost.grid.evidence.hits, ghost.grid.evidence.mean)
    )
    cells = np.argwhere(hits > 0)
    patches = (cells + CONFIG.corner_index + 0.5 + mean[tuple(cells.T)]) * CONFIG.voxel_size
    apart = np.linalg.norm(patches[:, None] - CENTERS, axis=-1) - (RADII + 0.02)
    inside = tuple(cells[(apart < -0.002).any(axis=1)].T)
    assert len(inside[0]) >= 3
    assert (hits[inside] > 0).all()
    assert not np.asarray(cleared.grid.evidence.hits)[inside].any()
    assert (np.asarray(cleared.grid.evidence.passes)[inside] > 0).all()
    assert float(hio.sdf(cleared, CENTERS[0])) > 0.1 > float(hio.sdf(ghost, CENTERS[0]))


def test_surfaces_just_beyond_the_margin_stay(empty_map):
    cloud, pose = room_cloud(0)
    expected = hio.update(empty_map, cloud, pose)
    point_world = cloud[0] @ pose[:3, :3].T + pose[:3, 3]
    beside = point_world[None] + [[0.0, 0.0, 0.2]]  # 20 cm away, more than the radius and 3 cm
    near = np.linalg.norm(cloud @ pose[:3, :3].T + pose[:3, 3] - beside, axis=1).min()
    assert near > 0.005
    beside = np.repeat(beside, 2, axis=0)  # as many spheres as above: one compilation
    radii = np.full(2, max(near - 0.035, 0), np.float32)
    assert arrays_equal(update(empty_map, cloud, pose, (beside, radii)).grid, expected.grid)


def test_the_margin_is_three_standard_deviations_of_a_noisy_return():
    cloud = np.array([[1.0, 0, 0], [2.0, 0, 0]], np.float32)
    finite, pose = np.ones(2, bool), np.eye(4, dtype=np.float32)
    radii = np.full(2, 0.1, np.float32)
    for noise, margins in (((0.005, 0.0), (0.03, 0.03)), ((0.01, 0.02), (0.09, 0.27))):
        placed = rays.place_cloud(CONFIG, cloud, finite, pose, jnp.asarray(noise))
        for gap, found in ((-0.002, True), (0.002, False)):
            reach = radii + np.asarray(margins, np.float32) + np.float32(gap)
            centers = cloud + reach[:, None] * np.array([[0, 1, 0]], np.float32)
            left = rays.remove_robot(placed, jnp.asarray(centers), jnp.asarray(radii))
            assert (np.asarray(left.ends) == (not found)).all()
            assert (np.asarray(left.in_range) == (not found)).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_host_finds_the_same_returns_on_the_robot(seed):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(400, 3)).astype(np.float32)
    cloud[:20, seed % 3] = np.nan
    finite = np.isfinite(cloud).all(axis=1)
    pose = room_cloud(seed)[1]
    centers, radii = rng.normal(size=(4, 3)).astype(np.float32), rng.uniform(0.4, 0.9, 4)
    noise = np.array([0.01, 0.02], np.float32)
    placed = rays.place_cloud(CONFIG, cloud, finite, pose, jnp.asarray(noise))
    left = rays.remove_robot(placed, jnp.asarray(centers), jnp.asarray(radii, jnp.float32))
    expected = np.asarray(placed.in_range & ~left.in_range)
    assert 20 < expected.sum() < 360
    robot = centers, radii.astype(np.float32)
    on_host, only_robot = robot_and_noise.leave_out_robot_on_host(cloud, pose, robot, noise)
    assert not only_robot
    traced = jax.jit(robot_and_noise.leave_out_robot)(cloud, pose, robot, noise)
    for left in (on_host, np.asarray(traced)):
        found = finite & np.isnan(left).any(axis=1)
        np.testing.assert_array_equal(found[placed.in_range], expected[placed.in_range])
        np.testing.assert_array_equal(left[~found], cloud[~found])


def test_no_spheres_are_no_robot(empty_map):
    cloud, pose = room_cloud(0)
    nothing = (np.zeros((0, 3)), np.zeros(0))
    expected = hio.update(empty_map, cloud, pose)
    assert arrays_equal(hio.update(empty_map, cloud, pose, robot=nothing), expected)


def test_the_robot_is_traced(empty_map):
    _, covered, _, pose = cloud_with_an_arm()
    update(empty_map, covered, pose, (CENTERS, RADII))
    compiled = pipeline._update_jit._cache_size()
    moved = update(empty_map, covered, pose, (CENTERS + 0.1, 2 * RADII))
    assert pipeline._update_jit._cache_size() == compiled
    assert int(moved.report.points_used) > 0

    def step(state, centers):
        return hio.update(state, jnp.asarray(covered), jnp.asarray(pose), robot=(centers, RADII))

    assert jax.eval_shape(step, empty_map, CENTERS).config == CONFIG


def test_hits_are_weighted_by_the_noise_of_their_cloud(empty_map):
    """Two clouds of one point each fall in one voxel, weighted by their inverse variances."""
    ends = np.array([[0.72, 0.02, 0.03], [0.78, 0.08, 0.06]], np.float32)
    noises = [(0.004, 0.001), (0.016, 0.003)]
    state = empty_map
    for end, noise in zip(ends, noises, strict=True):
        state = update(state, end[None], np.eye(4), noise=noise)
    square = np.sum(ends.astype(float) ** 2, axis=1)
    weight = np.array([1 / (a + b * r) ** 2 for (a, b), r in zip(noises, square, strict=True)])
    expected = weight @ ends / weight.sum()
    at = tuple(np.floor(expected / 0.1 + 1e-6).astype(int) - CONFIG.corner_index)
    center = (np.array(at) + CONFIG.corner_index + 0.5) * 0.1
    mean = center + 0.1 * np.asarray(state.grid.evidence.mean[at], float)
    np.testing.assert_allclose(mean, expected, atol=2e-4)  # float16
    total = CONFIG.range_noise[0] ** 2 * weight.sum()
    np.testing.assert_allclose(float(state.grid.evidence.root_weight[at]) ** 2, total, rtol=5e-3)


def test_the_configurations_noise_is_the_default(empty_map):
    cloud, pose = room_cloud(0)
    plain = hio.update(empty_map, cloud, pose)
    given = hio.update(empty_map, cloud, pose, noise=CONFIG.range_noise)
    assert arrays_equal(given.grid.evidence.hits, plain.grid.evidence.hits)
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 3)).astype(np.float32)
    np.testing.assert_allclose(distances(given, points), distances(plain, points), atol=2e-3)


@pytest.mark.parametrize(
    "extras, message",
    [
        ({"robot": 3}, "robot is 3, expected"),
        ({"robot": (CENTERS, RADII[:1])}, r"robot has centers of shape \(2, 3\)"),
        ({"robot": (CENTERS[:, :2], RADII)}, r"robot has centers of shape \(2, 2\)"),
        ({"robot": (CENTERS * np.nan, RADII)}, "robot centers has values"),
        ({"robot": (CENTERS, -RADII)}, "robot radii has values"),
        ({"robot": (CENTERS, 1000 * RADII)}, "from 50.0 to 60.0, expected meters, .* millimeters"),
        ({"robot": (CENTERS, 0.1)}, r"robot has .* radii of shape \(\), expected \(K, 3\) and"),
        ({"noise": 0.01}, "noise is 0.01, expected two numbers"),
        ({"noise": (5, 0.1)}, "noise a has values .* expected meters, at most 1; .* millimeters"),
        ({"noise": (0.01, 2)}, "noise b has values .* expected 1/m, at most 1"),
        ({"noise": (0.0, 0.1)}, "noise a has values"),
        ({"noise": (1e-22, 0.0)}, "noise a has values"),
        ({"noise": (10**400, 0.0)}, "noise has dtype object"),
        ({"robot": ([["a", "b", "c"]], [1.0])}, "robot centers has dtype"),
        ({"noise": (0.01, -0.1)}, "noise b has values"),
    ],
)
def test_bad_extras_are_refused(empty_map, extras, message):
    cloud, pose = room_cloud(0)
    with pytest.raises(ValueError, match=message):
        hio.update(empty_map, cloud, pose, **extras)


def test_a_pose_too_far_away_is_refused(empty_map):
    cloud, pose = room_cloud(0)
    pose[0, 3] = 1e20
    with pytest.raises(ValueError, match=r"pose is 1e\+17 km from the origin, .* at most 100 km"):
        hio.update(empty_map, cloud, pose)
    padded = np.full((CONFIG.max_points, 3), np.nan, np.float32)
    padded[: len(cloud)] = cloud
    inside = pipeline._update_jit(
        empty_map, padded, pose, None, None, NO_FLAG
    )  # what `update` compiles
    flag = jnp.uint32(hio.Flag.BAD_POSE)
    flagged = empty_map.report.replace(flags=flag, update_flags=flag)
    assert arrays_equal(inside, empty_map.replace(report=flagged))


BAD_INSIDE_JIT = {
    "NaN center": {"robot": (CENTERS * np.nan, RADII)},
    "negative radius": {"robot": (CENTERS, -RADII)},
    "infinite radius": {"robot": (CENTERS, RADII * np.inf)},
    "NaN radius": {"robot": (CENTERS, RADII * np.nan)},
    "radius in millimeters": {"robot": (CENTERS, 1000 * RADII)},
    "no noise": {"noise": np.zeros(2, np.float32)},
    "NaN noise": {"noise": np.full(2, np.nan, np.float32)},
    "tiny noise": {"noise": np.array([1e-22, 0], np.float32)},
    "noise in millimeters": {"noise": np.array([5, 2], np.float32)},
}


@pytest.mark.parametrize("extras", BAD_INSIDE_JIT.values(), ids=BAD_INSIDE_JIT.keys())
def test_bad_extras_inside_jit_change_nothing_and_raise_a_flag(empty_map, extras):
    cloud, pose = room_cloud(0)
    padded = np.full((CONFIG.max_points, 3), np.nan, np.float32)
    padded[: len(cloud)] = cloud
    noise = jnp.asarray(extras.get("noise", CONFIG.range_noise), jnp.float32)
    # What `update` has compiled for the tests above.
    after = pipeline._update_jit(empty_map, padded, pose, extras.get("robot", AWAY), noise, NO_FLAG)
    flag = jnp.uint32(hio.Flag.BAD_ARGUMENT)
    flagged = empty_map.report.replace(flags=flag, update_flags=flag)
    assert arrays_equal(after, empty_map.replace(report=flagged))
