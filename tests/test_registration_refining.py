"""Poses refined by a map: exact fields, noise, corridors, derivatives, wrong input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import HALF, room_cloud
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.registration import comparing, equations, solving

RESOLUTION = 0.05
NOISE = (0.01, 0.0)
COUNT = 700
MANY = 200
NO_WEIGHT = np.zeros((4, 4), np.float32)


def baked_field(distance, half):
    """Bakes an exact distance function of points (..., 3) in a box."""
    half = np.asarray(half)
    shape = tuple(np.ceil(2 * half / RESOLUTION).astype(int) + 1)
    points = -half + RESOLUTION * np.stack(np.indices(shape), axis=-1)
    values = jnp.asarray(distance(points), jnp.float32)
    return hio.Baked(
        corner_world=jnp.asarray(-half, jnp.float32),
        resolution=jnp.float32(RESOLUTION),
        sdf=values,
        frontier=jnp.full(shape, 1.0, jnp.float32),
        lower=values,
        updates=jnp.int32(10),
        stamp=jnp.float32(0),
    )


@pytest.fixture(scope="module")
def room():
    return baked_field(lambda points: (HALF - np.abs(points)).min(axis=-1), HALF + 0.6)


@pytest.fixture(scope="module")
def corridor():
    """Two parallel walls, without floor, ceiling or end, in as many samples: one compilation."""
    return baked_field(lambda points: 1 - np.abs(points[..., 1]), HALF + 0.6)


def moved(pose, translation, turn):
    result = np.array(pose, float)
    result[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ result[:3, :3]
    result[:3, 3] += translation
    return result.astype(np.float32)


def perturbed(pose, rng, way_m, angle_deg):
    way, turn = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    return moved(pose, way_m * way, np.radians(angle_deg) * turn)


def error(pose, exact):
    """The motion from the exact pose to another, (6,) m and rad."""
    pose, exact = np.asarray(pose, float), np.asarray(exact, float)
    turn = Rotation.from_matrix(pose[:3, :3] @ exact[:3, :3].T).as_rotvec()
    return np.concatenate([pose[:3, 3] - exact[:3, 3], turn])


def noisy(cloud, rng, sigma=NOISE[0]):
    ranges = np.linalg.norm(cloud, axis=1, keepdims=True)
    return (cloud * (1 + sigma * rng.normal(size=ranges.shape) / ranges)).astype(np.float32)


@jax.jit
def refine_and_slope(field, cloud, pose, weight):
    """Also the gradient of the pose's weighted entries by the cloud, in the same compilation."""

    def score(cloud):
        found = hio.refine_pose(field, cloud, pose, noise=NOISE)
        return jnp.sum(weight * found.pose), found

    slope, found = jax.grad(score, has_aux=True)(cloud)
    return found, slope


@jax.jit
def refine_and_slope_with_prior(field, cloud, pose, mean, covariance, weight):
    """The same with a prior; the gradient is that by its mean."""

    def score(mean):
        found = hio.refine_pose(field, cloud, pose, (mean, covariance), noise=NOISE)
        return jnp.sum(weight * found.pose), found

    slope, found = jax.grad(score, has_aux=True)(mean)
    return found, slope


@jax.jit
def refine_all(field, clouds, poses):
    """Refines `MANY` poses: a loop over batches."""

    def refine_one(frame):
        return hio.refine_pose(field, *frame, noise=NOISE)

    return jax.lax.map(refine_one, (clouds, poses), batch_size=MANY // 4)


def refine(field, cloud, pose):
    return refine_and_slope(field, cloud, pose, NO_WEIGHT)[0]


def refine_with_prior(field, cloud, pose, mean, covariance):
    return refine_and_slope_with_prior(field, cloud, pose, mean, covariance, NO_WEIGHT)[0]


@pytest.mark.parametrize("seed", range(6))
def test_a_pose_15_cm_and_6_degrees_off_is_found(room, seed):
    cloud, pose = room_cloud(seed, COUNT, 0.3 * seed, (0.1, -0.05, 0.08))
    found = refine(room, cloud, perturbed(pose, np.random.default_rng(seed), 0.15, 6))
    away = error(found.pose, pose)
    assert np.linalg.norm(away[:3]) < 1e-3
    assert np.linalg.norm(away[3:]) < 1e-3
    assert bool(found.converged)
    assert float(found.inliers) > 0.99
    assert float(found.residual) < 2e-3


def test_noise_and_outliers_against_scipy(room):
    """The same loss, minimized in float64 on the exact planes."""
    rng = np.random.default_rng(0)
    cloud, pose = room_cloud(3, COUNT, 0.4, (0.2, 0.1, 0.0))
    cloud = noisy(cloud, rng)
    cloud[::10] *= rng.uniform(0.5, 0.9, (len(cloud[::10]), 1)).astype(np.float32)

    def residuals(motion):
        turn = Rotation.from_rotvec(motion[3:]).as_matrix() @ pose[:3, :3]
        offset = cloud @ turn.T
        to_walls = HALF - np.abs(offset + pose[:3, 3] + motion[:3])
        wall = to_walls.argmin(axis=1)
        along = np.take_along_axis(offset, wall[:, None], axis=1)[:, 0] ** 2
        variance = NOISE[0] ** 2 * along / (offset**2).sum(axis=1)
        ratio = to_walls.min(axis=1) / np.sqrt(variance + 0.005**2 + 0.0025**2) / 3
        return ratio / np.sqrt(1 + ratio**2)

    expected = least_squares(residuals, np.zeros(6), xtol=1e-12, ftol=1e-12).x
    found = refine(room, cloud, perturbed(pose, rng, 0.05, 3))
    away = error(found.pose, pose)
    np.testing.assert_allclose(away, expected, atol=5e-4)
    assert np.linalg.norm(expected[:3]) < 5e-3
    assert 0.85 < float(found.inliers) < 0.95


def test_the_covariance_is_that_of_the_errors(room):
    rng = np.random.default_rng(1)
    clouds, poses = zip(
        *(room_cloud(i, COUNT, 0.1 * i, rng.uniform(-0.2, 0.2, 3)) for i in range(MANY)),
        strict=True,
    )
    starts = np.stack([perturbed(pose, rng, 0.05, 3) for pose in poses])
    clouds = np.stack([noisy(cloud, rng) for cloud in clouds])
    found = refine_all(room, clouds, starts)
    away = np.stack([error(a, b) for a, b in zip(np.asarray(found.pose), poses, strict=True)])
    square = np.einsum("ni,nij,nj->n", away, np.linalg.inv(np.asarray(found.covariance)), away)
    high = chi2.ppf(0.975, 6)
    # Never too sure. The floor of the noise, which the map's own errors need, is cautious here.
    assert np.mean(square > high) < 0.05
    assert 2 < square.mean() < 6.5


def test_one_cloud_batches_and_jit_agree(room):
    cloud, pose = room_cloud(5, COUNT)
    starts = np.stack([perturbed(pose, np.random.default_rng(i), 0.05, 3) for i in range(3)])
    one = [refine(room, cloud, start) for start in starts]
    which = np.arange(MANY) % 3
    batches = refine_all(room, np.broadcast_to(cloud, (MANY, COUNT, 3)), starts[which])
    eager = hio.refine_pose(room, cloud, starts[0], noise=NOISE)
    expected = np.stack([single.pose for single in one])[which]
    np.testing.assert_allclose(batches.pose, expected, atol=1e-4)
    np.testing.assert_allclose(eager.pose, one[0].pose, atol=1e-4)


def test_rows_without_returns_change_nothing(room):
    cloud, pose = room_cloud(6, COUNT)
    start = perturbed(pose, np.random.default_rng(0), 0.05, 3)
    more = np.full((COUNT + 300, 3), np.nan, np.float32)
    more[150 : 150 + COUNT] = cloud
    expected = hio.refine_pose(room, cloud, start, noise=NOISE)
    found = hio.refine_pose(room, more, start, noise=NOISE)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_small_cloud_is_used_whole_however_it_is_padded(room):
    rng = np.random.default_rng(12)
    cloud, pose = room_cloud(12, COUNT)
    cloud = noisy(cloud, rng)
    start = perturbed(pose, rng, 0.05, 3)
    padded = hio.refine_pose(room, cloud, start, noise=NOISE)  # outside jit, to 16,384 rows
    whole = refine(room, cloud, start)
    np.testing.assert_allclose(padded.pose, whole.pose, atol=1e-4)
    np.testing.assert_allclose(padded.residual, whole.residual, atol=1e-4)
    np.testing.assert_allclose(padded.covariance, whole.covariance, rtol=0.05, atol=1e-7)
    assert float(padded.inliers) == pytest.approx(float(whole.inliers), abs=0.002)


def corridor_cloud(rng, count=COUNT):
    along, height = rng.uniform(-1.2, 1.2, count), rng.uniform(-0.8, 0.8, count)
    side = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    return noisy(np.stack([along, side, height], axis=1), rng)


def test_a_corridor_leaves_its_length_as_it_was(corridor):
    rng = np.random.default_rng(2)
    cloud, translation = corridor_cloud(rng), np.array([0.07, 0.04, -0.03])
    start = moved(np.eye(4), translation, [0.02, 0.0, -0.03])
    found = refine(corridor, cloud, start)
    way = np.asarray(found.pose)[:3, 3] - translation
    assert np.abs(way[[0, 2]]).max() < 1e-3
    assert abs(found.pose[1, 3]) < 3e-3
    deviation = np.sqrt(np.diag(found.covariance))
    assert (deviation[[0, 2]] > 50).all()
    assert deviation[1] < 0.01
    # Neither does it show the turn about the walls' normal.
    turn = error(found.pose, np.eye(4))[3:]
    assert np.abs(turn[[0, 2]]).max() < 3e-3
    assert abs(turn[1]) < 2e-3


def test_a_prior_holds_what_the_corridor_leaves_open(corridor):
    rng = np.random.default_rng(3)
    cloud, mean = corridor_cloud(rng), moved(np.eye(4), [0.1, 0.05, 0.02], [0.01, 0.02, 0.0])
    prior = np.diag([0.1, 0.1, 0.1, 0.05, 0.05, 0.05]).astype(np.float32) ** 2
    found = refine_with_prior(corridor, cloud, np.eye(4, dtype=np.float32), mean, prior)
    assert np.abs(np.asarray(found.pose)[[0, 2], 3] - mean[[0, 2], 3]).max() < 2e-3
    assert abs(found.pose[1, 3]) < 3e-3
    deviation = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(deviation[[0, 2, 4]], [0.1, 0.1, 0.05], rtol=0.05)
    assert deviation[1] < 0.01


def test_a_sure_prior_decides(room):
    cloud, pose = room_cloud(8, COUNT)
    mean = moved(pose, [0.02, 0.0, 0.0], [0.0, 0.0, 0.01])
    sure = (1e-5**2 * np.eye(6)).astype(np.float32)
    found = refine_with_prior(room, cloud, pose, mean, sure)
    np.testing.assert_allclose(found.pose, mean, atol=1e-4)


def smooth_frame(rng):
    """A cloud away from the edges, where the distance has kinks, and a pose that is off."""
    cloud, pose = room_cloud(9, COUNT, 0.2, (0.1, 0.0, 0.05))
    world = cloud @ pose[:3, :3].T + pose[:3, 3]
    near = np.sort(HALF - np.abs(world), axis=1)
    cloud = np.where(near[:, 1:2] > 0.12, noisy(cloud, rng, 0.003), np.nan).astype(np.float32)
    return cloud, perturbed(pose, rng, 0.02, 1)


def test_derivatives_by_the_cloud_are_finite_differences(room):
    rng = np.random.default_rng(4)
    cloud, start = smooth_frame(rng)
    # Affine: of independent ways of 700 returns hardly anything would remain.
    affine = (
        rng.normal(size=(3, 3, 3)).astype(np.float32),
        rng.normal(size=(3, 3)).astype(np.float32),
    )
    ways = [np.nan_to_num(cloud) @ a + b for a, b in zip(*affine, strict=True)]
    weight = rng.normal(size=(4, 4)).astype(np.float32)

    def score(cloud):
        return np.sum(weight * refine(room, cloud, start).pose)

    slope = np.nan_to_num(refine_and_slope(room, cloud, start, weight)[1])
    for way in ways:
        step = 2e-3
        change = (score(cloud + step * way) - score(cloud - step * way)) / (2 * step)
        size = np.linalg.norm(weight) * np.abs(way).mean()
        assert abs(np.sum(slope * way) - change) < 0.01 * max(abs(change), 0.1 * size)


@jax.jit
def derivatives(field, cloud, pose, ways, weight):
    """A score's gradient and second derivatives where cloud and field move; the pose is solved."""
    none_free = equations.Directions(jnp.eye(6), jnp.zeros(6, bool))

    def score(at):
        some = jnp.isfinite(cloud[:, 0])
        points = jnp.where(some[:, None], cloud + at[0] * ways[0], 0)
        rows = comparing.make_rows(points, some, NOISE)
        changed = field.replace(sdf=field.sdf + at[1] * ways[1])
        anchor = equations.Anchor(pose, None)
        solved = solving.differentiable(changed, rows, anchor, pose, none_free, jnp.float32(1))
        return jnp.sum(weight * solved)

    at, along = jnp.zeros(2), jnp.array([1.0, 0.0])
    slope, curvature = jax.jvp(jax.grad(score), (at,), (along,))
    return slope, jax.jvp(score, (at,), (along,))[1], curvature


def test_derivatives_by_the_field_and_of_second_order_are_finite_differences(room):
    rng = np.random.default_rng(4)
    cloud, start = smooth_frame(rng)
    turned = np.nan_to_num(cloud) @ rng.normal(size=(3, 3)).astype(np.float32)
    # Surfaces move along x.
    shape = np.linspace(-1, 1, room.sdf.shape[0], dtype=np.float32)[:, None, None]
    ways = turned, np.broadcast_to(shape, room.sdf.shape)
    weight = rng.normal(size=(4, 4)).astype(np.float32)

    def solve(cloud_way, field_way):
        moved = cloud + np.float32(cloud_way) * ways[0]
        changed = room.replace(sdf=room.sdf + np.float32(field_way) * ways[1])
        return changed, moved, refine(changed, moved, start).pose

    def score(*way):
        return np.sum(weight * solve(*way)[2])

    slope, forward, curvature = derivatives(*solve(0, 0), ways, weight)
    np.testing.assert_allclose(forward, slope[0], rtol=1e-4)
    step = 2e-3
    by_cloud = (score(step, 0) - score(-step, 0)) / (2 * step)
    by_field = (score(0, step) - score(0, -step)) / (2 * step)
    np.testing.assert_allclose(slope, [by_cloud, by_field], rtol=0.01)
    before, after = (derivatives(*solve(way, 0), ways, weight)[0] for way in (-step, step))
    bend = (after - before) / (2 * step)
    np.testing.assert_allclose(curvature, bend, rtol=0.1)


def test_derivatives_by_the_prior_are_finite_differences(corridor):
    """By its position and its rotation; it decides what the corridor leaves open."""
    rng = np.random.default_rng(5)
    cloud = corridor_cloud(rng)
    prior = np.diag([0.1, 0.02, 0.1, 0.05, 0.05, 0.05]).astype(np.float32) ** 2
    eye, weight = np.eye(4, dtype=np.float32), rng.normal(size=(4, 4)).astype(np.float32)
    mean = moved(eye, [0.03, 0.01, -0.02], [0.01, 0.03, -0.02])

    def score_and_slope(mean):
        return refine_and_slope_with_prior(corridor, cloud, eye, mean, prior, weight)

    def score(mean):
        return np.asarray(score_and_slope(mean)[0].pose, float)

    slope = np.asarray(score_and_slope(mean)[1], float)

    def change(motion, step=5e-3):
        """The central difference along a motion, and the derivative that the gradient predicts."""
        behind, ahead = (moved(mean, h * motion[:3], h * motion[3:]) for h in (-step, step))
        by_steps = np.sum(weight * (score(ahead) - score(behind))) / (2 * step)
        return by_steps, np.sum(slope * (ahead - behind)) / (2 * step)

    by_steps, predicted = np.array([change(motion) for motion in np.eye(6)]).T
    np.testing.assert_allclose(predicted, by_steps, atol=0.01 * np.linalg.norm(by_steps))
    np.testing.assert_allclose(predicted[[0, 2]], weight[[0, 2], 3], rtol=0.01)


def test_a_cloud_of_another_place_is_not_registered(room):
    rng = np.random.default_rng(6)
    cloud = rng.normal(size=(COUNT, 3)).astype(np.float32)
    assert not bool(refine(room, cloud, np.eye(4, dtype=np.float32)).converged)
    far = moved(np.eye(4), [50, 0, 0], np.zeros(3))
    lost, slope = refine_and_slope(room, room_cloud(0, COUNT)[0], far, np.ones((4, 4), np.float32))
    assert not bool(lost.converged)
    np.testing.assert_allclose(lost.pose, far)
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("wrong", [np.full((4, 4), np.nan), np.diag([1, 1, -1, 1])])
def test_inside_jit_a_pose_that_is_not_rigid_stays_and_has_no_derivatives(room, wrong):
    cloud, _ = room_cloud(0, COUNT)
    wrong, weight = wrong.astype(np.float32), np.ones((4, 4), np.float32)
    found, slope = refine_and_slope(room, cloud, wrong, weight)
    assert not bool(found.converged)
    np.testing.assert_array_equal(found.pose, wrong)
    np.testing.assert_array_equal(slope, 0)
    eye, prior = np.eye(4, dtype=np.float32), np.eye(6, dtype=np.float32)
    found, slope = refine_and_slope_with_prior(room, cloud, eye, wrong, prior, weight)
    assert not bool(found.converged)
    np.testing.assert_array_equal(slope, 0)


def test_a_pose_half_a_turn_from_its_prior_has_not_converged(room):
    cloud, pose = room_cloud(8, COUNT)
    prior = (0.1**2 * np.eye(6)).astype(np.float32)
    for turn_rad, converged in ((0.0, True), (np.pi, False)):
        mean = moved(pose, np.zeros(3), [0, 0, turn_rad])
        found = refine_with_prior(room, cloud, pose, mean, prior)
        assert bool(found.converged) == converged


def test_a_pose_that_has_not_converged_has_the_derivatives_of_a_constant(room):
    cloud = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    weight = np.ones((4, 4), np.float32)
    found, slope = refine_and_slope(room, cloud, np.eye(4, dtype=np.float32), weight)
    assert not bool(found.converged)
    assert np.isfinite(found.pose).all()
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((6, 6)),
        -1e4 * np.eye(6),
        np.diag([1.0, 1, 1, 1, 1, -1]),
        np.nan * np.eye(6),
        np.eye(6) + 2 * np.eye(6, k=1) + 2 * np.eye(6, k=-1),  # indefinite
        np.eye(6) + 0.3 * np.eye(6, k=1),  # not symmetric
    ],
)
def test_no_pose_converges_by_a_prior_that_is_no_covariance(room, covariance):
    """Inside jit, where no message is possible; derivatives stay finite."""
    cloud, pose = room_cloud(0, COUNT)
    given = np.float32(pose), np.float32(1e-4 * covariance)
    weight = np.ones((4, 4), np.float32)
    found, slope = refine_and_slope_with_prior(room, cloud, np.float32(pose), *given, weight)
    assert not bool(found.converged)
    assert np.isfinite(found.pose).all()
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("reach_m", [0.0, -1.0, np.nan, np.inf, 1e30])
def test_no_pose_converges_by_a_reach_that_is_out_of_range(room, reach_m):
    cloud, pose = room_cloud(0, COUNT)
    found = jax.jit(lambda reach_m: hio.refine_pose(room, cloud, pose, reach_m=reach_m))(reach_m)
    assert not bool(found.converged)


def test_the_reach_has_a_gradient(room):
    """It is zero, but a loop that ends early has none in reverse mode."""

    def score(reach_m):
        return jnp.sum(hio.refine_pose(room, np.ones((5, 3)), np.eye(4), reach_m=reach_m).pose)

    assert jax.eval_shape(jax.grad(score), jnp.float32(0.7)).shape == ()


@pytest.mark.parametrize("sigma", [0.0, 0.002, 0.01])
@pytest.mark.parametrize(
    ("along", "free"), [([1.0, 0.0, 0.0], 4), ([1.0, 0.0, 0.7], 4), ([0.0, 0.0, 0.0], 5)]
)
def test_a_line_or_a_point_of_returns_moves_only_onto_its_wall(corridor, along, free, sigma):
    rng = np.random.default_rng(0)
    cloud = np.array([0.2, 1.0, -0.1]) + rng.uniform(-0.5, 0.5, (COUNT, 1)) * along
    cloud = noisy(cloud, rng, sigma)
    start = moved(np.eye(4), [0.03, 0.04, -0.02], [0.01, 0.02, -0.015])
    found = refine(corridor, cloud, start)
    way = np.linalg.norm(error(found.pose, start)[:3])
    assert way < 0.06 or not bool(found.converged)
    rows = comparing.make_rows(jnp.asarray(cloud), jnp.ones(COUNT, bool), NOISE)
    here = comparing.compare(corridor, rows, np.eye(4), 0.0)
    assert int(equations.find_directions(corridor, rows, np.eye(4), here).free.sum()) == free


def test_the_covariance_of_an_oblique_corridor_is_a_prior(corridor):
    """In float32 it is singular: 100 m along the corridor, and millimeters across."""
    rng = np.random.default_rng(10)
    cloud = corridor_cloud(rng)
    eye = np.eye(4, dtype=np.float32)
    along_axes = refine(corridor, cloud, eye)
    turn = np.kron(np.eye(2), Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix())
    oblique = (turn @ np.asarray(along_axes.covariance, float) @ turn.T).astype(np.float32)
    given = moved(eye, [0.02, 0.02, 0.0], np.zeros(3))
    found = hio.refine_pose(corridor, cloud, given, (given, oblique), noise=NOISE)
    assert np.isfinite(np.asarray(found.pose)).all()
    assert abs(found.pose[1, 3]) < 3e-3


def test_inside_jit_an_empty_cloud_keeps_the_pose(room):
    pose = moved(np.eye(4), [0.1, 0, 0], [0.1, 0, 0])
    found = refine(room, np.full((COUNT, 3), np.nan, np.float32), pose)
    assert not bool(found.converged)
    np.testing.assert_allclose(found.pose, pose, atol=1e-6)


@pytest.mark.parametrize("cloud", [np.zeros((5, 3)), np.full((5, 3), 3e3)])
def test_without_a_usable_return_the_covariance_says_unknown(room, cloud):
    found = hio.refine_pose(room, cloud, np.eye(4), noise=NOISE)
    assert not bool(found.converged)
    np.testing.assert_allclose(found.covariance, 100**2 * np.eye(6), rtol=1e-5)


def test_a_map_a_snapshot_and_a_baked_field_find_the_pose(sharp_map):
    cloud, pose = room_cloud(50, 3000, 0.3, (0.1, 0.05, 0.0))
    start = perturbed(pose, np.random.default_rng(7), 0.05, 3)
    of_map = hio.refine_pose(sharp_map, cloud, start)
    of_field = hio.refine_pose(hio.snapshot(sharp_map), cloud, start)
    np.testing.assert_array_equal(of_map.pose, of_field.pose)
    of_baked = hio.refine_pose(hio.bake(sharp_map), cloud, start)
    for found in (of_map, of_baked):
        away = error(found.pose, pose)
        assert bool(found.converged)
        assert np.linalg.norm(away[:3]) < 0.01
        assert np.linalg.norm(away[3:]) < 0.01


BAD = np.eye(4)
BAD[0, 0] = 2
UNIT = np.eye(6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"field": 3}, "field is int"),
        ({"cloud": np.zeros((5, 2))}, r"cloud has shape \(5, 2\)"),
        ({"cloud": np.full((5, 3), np.nan)}, "cloud has no finite row"),
        ({"cloud": np.full((5, 3), np.inf)}, "cloud has no finite row"),
        ({"pose": np.eye(3)}, "pose has shape"),
        ({"pose": BAD}, "^pose "),
        ({"prior": np.eye(4)}, "prior is "),
        ({"prior": (np.eye(4), np.eye(5))}, "prior has a mean of shape"),
        ({"prior": (np.eye(4), [[1], [2, 3]])}, "prior covariance is not an array of numbers"),
        ({"prior": (np.eye(4), UNIT - 2 * np.eye(6, k=1) - 2 * np.eye(6, k=-1))}, "not positive"),
        ({"prior": (np.eye(4), np.diag([1, 1, 1, 1, 1, 0]))}, "not positive definite"),
        ({"reach_m": 1e-30}, "reach_m is 1e-30, expected >= 0.001"),
        ({"reach_m": 1e20}, r"reach_m is 1e\+20, expected at most 100"),
        ({"prior": (BAD, UNIT)}, "prior: pose "),
        ({"prior": (np.eye(4), -UNIT)}, "prior covariance is not positive definite"),
        ({"prior": (np.eye(4), UNIT + np.eye(6, k=1))}, "prior covariance is not symmetric"),
        ({"prior": (np.eye(4), np.full((6, 6), np.inf))}, "prior covariance has values"),
        ({"noise": (0.0, 1.0)}, "noise a"),
        ({"starts": 0}, "starts is 0, expected a whole number >= 1"),
        ({"starts": 6}, "starts is 6, expected at most 5"),
        ({"starts": 2.0}, "starts is 2.0, expected a whole number"),
    ],
)
def test_wrong_input_is_named(room, change, message):
    cloud, pose = room_cloud(0, COUNT)
    arguments = {"field": room, "cloud": cloud, "pose": pose} | change
    with pytest.raises(ValueError, match=message):
        hio.refine_pose(**arguments)


def test_types_do_not_depend_on_the_modes_of_jax(sharp_map):
    """Strict promotion of 64-bit numbers: each other mode converts more of what is mixed."""
    cloud, pose = room_cloud(3, COUNT)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        found = jax.eval_shape(lambda: hio.refine_pose(sharp_map, jnp.asarray(cloud), pose))
        _, tracked = jax.eval_shape(lambda state: hio.track(state, cloud, pose), sharp_map)
        prior = (np.eye(4), np.eye(6))
        held = jax.eval_shape(lambda: hio.refine_pose(sharp_map, cloud, pose, prior))
    for answer in (found, tracked, held):
        assert [part.dtype for part in answer] == 4 * [jnp.float32] + [bool]


def test_vmap_over_poses_and_a_scan_of_single_clouds_trace(sharp_map):
    cloud, pose = room_cloud(3, COUNT)
    poses = np.stack([pose] * 3)
    many = jax.eval_shape(jax.vmap(hio.refine_pose, (None, None, 0)), sharp_map, cloud, poses)

    def step(pose, cloud):
        found = hio.refine_pose(sharp_map, cloud, pose)
        return found.pose, found

    last, each = jax.eval_shape(lambda: jax.lax.scan(step, pose, np.stack([cloud] * 3)))
    assert last.shape == (4, 4)
    for found in (many, each):
        assert [part.shape for part in found] == [(3, 4, 4), (3, 6, 6), (3,), (3,), (3,)]


def solve_with_steps(monkeypatch, step_at):
    """Runs the fine steps with given motions along x, m, instead of those of returns."""
    rows = comparing.make_rows(jnp.ones((1, 3)), jnp.ones(1, bool), (0.01, 0.001))
    made = []

    def find_step(sums, directions, anchor, rows, pose, *_):
        jax.debug.callback(lambda: made.append(1))
        return jnp.zeros(6).at[0].set(step_at(pose[0, 3]))

    def nothing(_, rows, pose, scale_m):
        zero = jnp.zeros(1)
        flag = jnp.zeros(1, bool)
        world = jnp.zeros((1, 3)) + 0 * pose[0, 3] + 0 * scale_m
        return comparing.Residuals(zero, jnp.zeros((1, 6)), zero, flag, flag, zero, world, zero)

    monkeypatch.setattr(solving, "find_step", find_step)
    monkeypatch.setattr(solving, "compare", nothing)
    monkeypatch.setattr(solving, "sum_returns", lambda *given: comparing.sums_of(nothing(*given)))
    directions = equations.Directions(jnp.eye(6), jnp.zeros(6, bool))
    anchor = equations.Anchor(jnp.eye(4), None)
    found = solving.solve_fine(None, rows, jnp.eye(4), directions, anchor)
    jax.effects_barrier()
    return found, len(made)


@pytest.mark.parametrize(
    "step_m, steps, rests",
    [(0.003, 24, False), (0.0015, 24, True), (8e-5, 24, True), (4e-5, 8, True)],
)
def test_a_pose_rests_by_the_length_of_its_whole_steps(monkeypatch, step_m, steps, rests):
    """Late steps shrink. That must not make a pose that still moves look as if it rested."""
    found, made = solve_with_steps(monkeypatch, lambda _: step_m)
    assert bool(found.rests) == rests
    assert made == steps
    parts = np.where(np.arange(steps) < 16, 1, 1 / np.maximum(np.arange(steps) - 14, 1))
    np.testing.assert_allclose(found.pose[0, 3], step_m * parts.sum(), rtol=1e-4)


def test_a_pose_that_jumps_far_to_and_fro_does_not_rest(monkeypatch):
    found, _ = solve_with_steps(monkeypatch, lambda x: jnp.where(x < 0.05, 0.1, -0.1))
    assert not bool(found.rests)


@pytest.mark.parametrize("kink_m", [0.0185, 0.0195, 0.02, 0.021, 0.0215])
def test_a_pose_that_jumps_around_a_kink_rests_there(monkeypatch, kink_m):
    """In a young map of a house, whole steps went 5 mm forth and 1 to 2 mm back for ever."""

    def step_at(x):
        return jnp.where(x < kink_m, 0.005, -0.0005 - 0.3 * (x - kink_m))

    found, made = solve_with_steps(monkeypatch, step_at)
    assert made == 24
    assert bool(found.rests)
    np.testing.assert_allclose(found.pose[0, 3], kink_m, atol=0.0025)
