"""The collision geometry of pyroki as spheres: where they are, and what they cover."""

import git_packages
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import half_space

from hiosdf_jax import planning

LENGTHS = np.array([0.3, 0.5, 0.4])
NAMES = ("base", "upper", "lower")


@pytest.fixture(autouse=True)
def packages(monkeypatch):
    git_packages.install(monkeypatch, "jaxls", "pyroki")


@pytest.fixture
def robot():
    return git_packages.Robot(jnp.asarray(LENGTHS))


def spheres():
    """One, two and no spheres, filled up to two."""
    centers = np.array([[[0.1, 0, 0], [0, 0, 0]], [[0.2, 0, 0.1], [0.5, 0, 0]], np.zeros((2, 3))])
    radii = np.array([[0.2, 0], [0.1, 0.05], [0, 0]])
    coll = git_packages.Sphere(git_packages.at(*centers), jnp.asarray(radii)[..., None])
    return git_packages.RobotCollision(coll, NAMES)


def capsules():
    """Along the links' z axes, tilted; the base has none."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[0, 0, 0], [0.2, 0, 0], [0.1, 0.05, 0]]
    poses[1:, :3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z along the link's x
    size = jnp.array([[0, 0], [0.06, 0.4], [0.05, 0.3]])
    coll = git_packages.Capsule(git_packages.Pose(jnp.asarray(poses, jnp.float32)), size)
    return git_packages.RobotCollision(coll, NAMES)


def placed(q, link, points):
    """Points of a link in the world, float64."""
    angles = np.cumsum([0, *q])
    origin = np.zeros(3)
    for length, angle in zip(LENGTHS[:link], angles[:link], strict=True):
        origin = origin + length * np.array([np.cos(angle), 0, -np.sin(angle)])
    c, s = np.cos(angles[link]), np.sin(angles[link])
    return points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + origin


def test_spheres_are_where_the_links_are_and_those_without_size_are_left_out(robot):
    body = planning.pyroki.robot_spheres(robot, spheres())
    q = np.random.default_rng(0).uniform(-2, 2, (2, 4, 2)).astype(np.float32)
    centers, radii = body(q)
    assert centers.shape == (2, 4, 3, 3)
    np.testing.assert_allclose(radii, [0.2, 0.1, 0.05], rtol=1e-6)
    for row, found in zip(q.reshape(8, 2), centers.reshape(8, 3, 3), strict=True):
        base = placed(row, 0, np.array([[0.1, 0, 0]]))
        upper = placed(row, 1, np.array([[0.2, 0, 0.1], [0.5, 0, 0]]))
        np.testing.assert_allclose(found, np.concatenate([base, upper]), atol=1e-5)
    centers, radii = planning.pyroki.robot_spheres(robot, spheres(), ignore=["base"])(q)
    assert centers.shape == (2, 4, 2, 3) and radii.shape == (2,)


def test_the_spheres_of_capsules_cover_them(robot):
    rng = np.random.default_rng(1)
    q = rng.uniform(-2, 2, 2).astype(np.float32)
    for count in (2, 5):
        body = planning.pyroki.robot_spheres(robot, capsules(), spheres_per_capsule=count)
        centers, radii = (np.asarray(part) for part in body(q))
        assert centers.shape == (2 * count, 3)
        for link, radius, length, middle in [(1, 0.06, 0.4, [0.2, 0, 0]), (2, 0.05, 0.3, None)]:
            middle = np.array([0.1, 0.05, 0] if middle is None else middle)
            around = rng.normal(size=(2000, 3))
            around *= radius / np.linalg.norm(around, axis=1, keepdims=True)
            along = rng.uniform(-length / 2, length / 2, (2000, 1)) * np.array([1.0, 0, 0])
            surface = placed(q, link, middle + along + around)
            gaps = np.linalg.norm(surface[:, None] - centers, axis=-1) - radii
            assert gaps.min(axis=1).max() < 1e-6
        widest = np.sqrt(0.06**2 + (0.4 / (2 * count - 2)) ** 2)
        np.testing.assert_allclose(radii[:count], widest, rtol=1e-6)


def test_a_cost_and_a_constraint_of_its_spheres(robot):
    import jaxls

    class Joints(jaxls.Var, default_factory=lambda: jnp.zeros(2)):
        pass

    body = planning.pyroki.robot_spheres(robot, capsules(), ignore=["base"])
    field = half_space([0.0, 0.0, 1.0], 0.2)
    q = np.array([[0.4, 0.3], [-0.5, 0.2]], np.float32)
    variable = Joints(jnp.arange(2))
    values = jaxls.VarValues.make([variable.with_value(q)])
    centers, radii = (np.asarray(part, float) for part in body(q))
    clearance = centers[..., 2] + 0.2 - radii
    make = planning.jaxls.clearance_cost(body, margin_m=0.1, weight=10.0)
    cost, _ = git_packages.evaluate(make(field, variable), values)
    np.testing.assert_allclose(cost, 10 * np.maximum(0.1 - clearance, 0), atol=1e-4)
    assert (cost[0] > 0).any() and not cost[1].any()
    make = planning.jaxls.clearance_constraint(body, margin_m=0.1)
    kept, jacobian = git_packages.evaluate(make(field, variable), values)
    np.testing.assert_allclose(kept, clearance - 0.1, atol=1e-5)
    for joint, step in enumerate(1e-2 * np.eye(2)):
        sides = body(q + step)[0][..., 2] - body(q - step)[0][..., 2]
        np.testing.assert_allclose(jacobian[..., joint], sides / 2e-2, atol=1e-3)


def test_what_is_no_robot_of_spheres_is_refused(robot):
    make = planning.pyroki.robot_spheres
    with pytest.raises(ValueError, match=r"ignore has \['hand'\], expected names of links"):
        make(robot, spheres(), ignore=["hand"])
    with pytest.raises(ValueError, match="no sphere on the links that are left"):
        make(robot, spheres(), ignore=["base", "upper"])
    with pytest.raises(ValueError, match="spheres_per_capsule is 1"):
        make(robot, capsules(), spheres_per_capsule=1)
    box = git_packages.Box(git_packages.at(*np.zeros((3, 3))), jnp.ones((3, 3)))
    with pytest.raises(ValueError, match="Box geometry, expected spheres or capsules"):
        make(robot, git_packages.RobotCollision(box, NAMES))
    with pytest.raises(ValueError, match="call robot_spheres outside jit"):
        jax.jit(lambda collision: make(robot, collision)(jnp.zeros(2)))(spheres())


def test_the_example_of_the_docstring_runs(robot):
    scope = {"jnp": jnp, "planning": planning, "robot": robot, "collision": capsules()}
    exec(git_packages.example_of(planning.pyroki.robot_spheres), scope)
    assert np.isfinite(scope["centers_world"]).all() and scope["radii"].shape == (10,)
