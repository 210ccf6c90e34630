"""Gradients through `update`, by the pose and the cloud, against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.grid import geometry, patches
from hiosdf_jax._src.numerics.vectors import split

STEP = 1e-3  # m and rad; the map's float16 resolves 2e-5 m
POINTS = (np.random.default_rng(1).uniform(-0.9, 0.9, (2000, 3)) * HALF).astype(np.float32)
POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
POSE[:3, 3] = (0.1, 0.05, -0.03)


def wall_cloud():
    """Returns in the middle of voxels of the walls: small steps move none into another voxel."""
    rng, rows = np.random.default_rng(0), []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        cells = [np.arange(-int(HALF[k] / 0.1) + 1, int(HALF[k] / 0.1) - 1, 2) for k in others]
        for side in (-1, 1):
            for cell in np.stack(np.meshgrid(*cells), axis=-1).reshape(-1, 2):
                points = np.empty((4, 3))
                points[:, axis] = side * HALF[axis] + rng.normal(0, 0.004, 4)
                points[:, others] = 0.1 * (cell + 0.5 + rng.uniform(-0.3, 0.3, (4, 2)))
                rows.append(points)
    rows = np.concatenate([rows[k] for k in rng.permutation(len(rows))[:75]])
    return ((rows - POSE[:3, 3]) @ POSE[:3, :3]).astype(np.float32)


CLOUD = wall_cloud()


def moved_pose(twist):
    """The pose after a small motion (rotation vector, shift) in the world, to second order."""
    x, y, z = twist[:3]
    cross = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = jnp.eye(3) + cross + 0.5 * cross @ cross
    pose = jnp.asarray(POSE, jnp.float32)
    return pose.at[:3, :3].set(turn @ pose[:3, :3]).at[:3, 3].add(twist[3:])


@pytest.fixture(scope="module")
def base(empty_map):
    return hio.update(empty_map, CLOUD, POSE)


def answers(base, state):
    """The answers of a map with the network of another one, which derivatives hold still."""
    return np.asarray(hio.sdf(state.replace(network=base.network), POINTS), float)


def pieces(state):
    """What the answers are piecewise smooth in."""
    corners = geometry.corners_of(CONFIG, split(jnp.asarray(POINTS))).flat
    derived = state.grid.derived
    nearest = np.asarray(derived.nearest).reshape(-1, 3)[np.asarray(corners)]
    return np.concatenate([*nearest.transpose(2, 0, 1), np.asarray(derived.side).ravel()[corners]])


def difference(base, vary):
    """Central differences of all answers, and where nothing jumps between."""
    ahead, behind = (hio.update(*vary(sign * STEP)) for sign in (1, -1))
    same = np.all(pieces(ahead) == pieces(behind), axis=0)
    return (answers(base, ahead) - answers(base, behind)) / (2 * STEP), same


@jax.jit
def pull_back(state, cloud, twist, weights):
    """The gradient of the weighted answers, by the twist of the pose and the cloud."""

    def loss(twist, cloud):
        return hio.sdf(hio.update(state, cloud, moved_pose(twist)), POINTS) @ weights

    return jax.grad(loss, argnums=(0, 1))(twist, cloud)


def test_the_gradient_equals_finite_differences(empty_map, base):
    rng = np.random.default_rng(2)
    still = jnp.zeros(6)
    # Smooth deformations: patches of four returns that move one by one turn too fast for the step.
    shifts = [CLOUD @ strain for strain in rng.normal(0, 1, (2, 3, 3))]
    shifts.append(CLOUD / np.linalg.norm(CLOUD, axis=1)[:, None])
    by_pose = [
        difference(base, lambda h, k=k: (empty_map, CLOUD, moved_pose(still.at[k].set(h))))
        for k in range(6)
    ]
    by_cloud = [difference(base, lambda h, s=s: (empty_map, CLOUD + h * s, POSE)) for s in shifts]
    smooth = np.all([same for _, same in by_pose + by_cloud], axis=0)
    smooth &= np.asarray(hio.query(base, POINTS).observed)
    assert smooth.sum() > 80
    weights = np.where(smooth, rng.normal(0, 1, len(POINTS)), 0)
    twist, cloud = pull_back(empty_map, CLOUD, still, weights.astype(np.float32))
    expected = np.array([values @ weights for values, _ in by_pose])
    np.testing.assert_allclose(twist, expected, atol=0.01 * np.linalg.norm(expected))
    assert np.linalg.norm(expected[:3]) > 1 and np.linalg.norm(expected[3:]) > 1
    along = np.array([np.sum(np.asarray(cloud) * shift) for shift in shifts])
    expected = np.array([values @ weights for values, _ in by_cloud])
    np.testing.assert_allclose(along, expected, atol=0.01 * np.linalg.norm(expected))


def test_rows_that_are_no_returns_have_no_gradient_and_no_nan(empty_map):
    cloud = np.array(CLOUD)
    cloud[::5] = np.nan
    cloud[1::5] *= 100  # out of range
    cloud[2::5] = cloud[2]  # all equal: a patch without extent
    twist, by_cloud = pull_back(empty_map, cloud, jnp.zeros(6), jnp.ones(len(POINTS)))
    assert np.isfinite(twist).all() and np.isfinite(by_cloud).all()
    assert not np.asarray(by_cloud)[::5].any() and not np.asarray(by_cloud)[1::5].any()
    assert np.asarray(by_cloud)[3::5].any()


def test_a_cloud_that_is_refused_has_gradient_zero(empty_map):
    far = np.full_like(CLOUD, 300.0)
    twist, by_cloud = pull_back(empty_map, far, jnp.zeros(6), jnp.ones(len(POINTS)))
    assert not np.asarray(twist).any() and not np.asarray(by_cloud).any()


def test_forward_mode_and_scans_are_traced(empty_map):
    """They use the same rules; what they cost to compile buys no more."""

    def scanned(twist):
        def step(state, cloud):
            return hio.update(state, cloud, moved_pose(twist)), None

        state, _ = jax.lax.scan(step, empty_map, jnp.stack([CLOUD, CLOUD]))
        return hio.sdf(state, POINTS)

    values, tangents = jax.eval_shape(lambda t: jax.jvp(scanned, (t,), (t,)), jnp.zeros(6))
    assert values.shape == tangents.shape == (len(POINTS),)


@jax.jit
def push_forward(spread, change):
    return jax.jvp(patches.principal_axes, (spread,), (change,))


@jax.jit
def slope_of_axes(spread):
    return jax.grad(lambda s: sum(jnp.sum(x) for x in patches.principal_axes(s)))(spread)


def test_principal_axes_turn_and_grow_as_in_float64():
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(40, 3, 3))
    spread = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(3)
    change = rng.normal(size=(40, 3, 3))
    change = change + change.transpose(0, 2, 1)

    def exact(spread):
        value, vector = np.linalg.eigh(spread)
        return np.sqrt(value[:, ::-1]), vector[:, :, ::-1].transpose(0, 2, 1)

    h = 1e-6
    (near, axes), (far, other) = exact(spread - h * change), exact(spread + h * change)
    other *= np.sign(np.sum(axes * other, axis=-1, keepdims=True))
    arguments = (array.astype(np.float32) for array in (spread, change))
    (deviation, direction), (grown, turned) = push_forward(*arguments)
    sign = np.sign(np.sum(axes * np.asarray(direction), axis=-1, keepdims=True))
    np.testing.assert_allclose(grown, (far - near) / (2 * h), rtol=2e-3, atol=2e-3)
    expected = sign * (other - axes) / (2 * h)
    np.testing.assert_allclose(turned, expected, rtol=1e-2, atol=1e-2 * np.abs(expected).max())
    assert np.all(np.asarray(deviation) > 0)


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_principal_axes_of_a_flat_patch_have_finite_derivatives(rank):
    factor = np.random.default_rng(4).normal(size=(40, 3, rank))
    spread = (factor @ factor.transpose(0, 2, 1)).astype(np.float32)
    for derivative in (
        push_forward(spread, np.ones_like(spread))[1],
        slope_of_axes(spread),
    ):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(derivative))
