"""frax's Panda: its spheres, its clearance and gradient, and a filter that guards it."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import panda_clearance as example
import pytest
from analytic import baked, count_traces, equalities_with_least, half_space, half_spaces
from scene import ROOM, exact_sdf

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import frax

    from hiosdf_jax.planning import cbf

from hiosdf_jax import planning

# Denavit-Hartenberg parameters as published by Franka (Craig's convention): a m, d m, alpha rad.
TURN = np.pi / 2
DH = [
    (0, 0.333, 0),
    (0, 0, -TURN),
    (0, 0.316, TURN),
    (0.0825, 0, TURN),
    (-0.0825, 0.384, -TURN),
    (0, 0, TURN),
    (0.088, 0, TURN),
]
BASE = np.array([[0, -1, 0, 1.4], [1, 0, 0, 2.0], [0, 0, 1, 0.1], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def panda():
    return frax.load_panda()


def reference_spheres(panda, q):
    """Centers in the world, (S, 3), float64."""
    transform, centers = BASE, []
    for (a, d, alpha), angle, spheres in zip(DH, q, panda.collision_positions, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        joint = [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca]]
        transform = transform @ np.array([*joint, [0, 0, 0, 1]])
        centers += [transform[:3, :3] @ sphere + transform[:3, 3] for sphere in spheres]
    return np.array(centers)


def reference_clearances(panda, q, exact):
    """Clearances of all spheres, (S,) m."""
    return exact(reference_spheres(panda, q)) - np.concatenate(panda.collision_radii)


def test_spheres_are_where_the_manufacturers_kinematics_put_them(panda):
    q = example.draw(panda, 30, np.random.default_rng(0))
    centers, radii = planning.frax.arm_spheres(panda, q.reshape(5, 6, 7), BASE)
    assert centers.shape == (5, 6, 21, 3)
    expected = np.array([reference_spheres(panda, row) for row in q])
    np.testing.assert_allclose(centers.reshape(30, 21, 3), expected, atol=1e-4)
    np.testing.assert_allclose(radii, np.concatenate(panda.collision_radii), rtol=1e-6)


def test_clearance_and_gradient_of_200_maps_with_one_compilation(panda):
    counted, traces = count_traces(planning.frax.arm_clearance_and_grad)
    cost = jax.jit(counted, static_argnums=1)
    q = example.draw(panda, 200, np.random.default_rng(1))
    q[1::2] = q[::2]  # Between the steps of a pair only the map changes.
    normals, offsets, fields = half_spaces(200)
    clearances, checked = np.zeros(200), 0
    for k, (normal, offset, field) in enumerate(zip(normals, offsets, fields, strict=True)):

        def exact(points, normal=normal, offset=offset):
            return points @ normal + offset

        value, gradient = cost(field, panda, q[k], BASE)
        spheres = np.sort(reference_clearances(panda, q[k], exact))
        np.testing.assert_allclose(value, spheres[0], atol=1e-4)
        clearances[k] = value
        # Where two spheres are equally near there is no derivative.
        if spheres[1] - spheres[0] > 1e-3 and checked < 60:
            step = 1e-6 * np.eye(7)
            slope = [
                reference_clearances(panda, q[k] + e, exact).min()
                - reference_clearances(panda, q[k] - e, exact).min()
                for e in step
            ]
            np.testing.assert_allclose(gradient, np.array(slope) / 2e-6, atol=1e-4)
            checked += 1
    assert len(traces) == 1
    assert checked == 60
    assert (
        equalities_with_least(
            lambda q: planning.frax.arm_clearance(fields[0], panda, q), jnp.asarray(q[0])
        )
        == 0
    )
    assert (np.abs(clearances[::2] - clearances[1::2]) > 0.01).mean() > 0.9


def test_4096_configurations_in_a_furnished_room(panda):
    field = baked(exact_sdf, ROOM[0] - 0.5, ROOM[1] + 0.5, 0.05)
    q = example.draw(panda, 4096, np.random.default_rng(2))
    value, gradient = example.clearance_and_grad(field, panda, q, BASE)
    assert value.shape == (4096,)
    assert gradient.shape == (4096, 7)
    assert np.isfinite(value).all()
    assert np.isfinite(gradient).all()
    expected = np.array([reference_clearances(panda, row, exact_sdf).min() for row in q])
    # Inside solids the scene's distances are bounds. The lattice rounds edges by a third of 5 cm.
    free = expected > 0
    assert 400 < free.sum() < 3700
    np.testing.assert_allclose(value[free], expected[free], atol=0.02)
    assert np.abs(value - expected)[free].mean() < 2e-3
    alone = [float(planning.frax.arm_clearance(field, panda, row, BASE)) for row in q[:3]]
    np.testing.assert_allclose(value[:3], alone, atol=1e-5)


def test_the_gradient_leads_out_of_collision(panda):
    field = baked(exact_sdf, ROOM[0] - 0.5, ROOM[1] + 0.5, 0.05)
    q = example.draw(panda, 600, np.random.default_rng(3))
    exact = example.exact_clearance(panda, q)
    near = q[(exact < 0) & (exact > -0.1)]
    assert len(near) > 20
    after = example.exact_clearance(panda, example.climb(field, panda, near))
    assert (after > 0).mean() > 0.8


def test_a_filter_guards_the_whole_arm(panda):
    """The filter over all 21 spheres, with joint goals in collision."""
    field = baked(exact_sdf, ROOM[0] - 0.5, ROOM[1] + 0.5, 0.05)
    # In 20 ms the farthest sphere travels about 2 cm; the lattice errs by 1 cm.
    safe = cbf.velocity_filter(
        lambda q: planning.frax.arm_spheres(panda, q, BASE), [0.6] * 7, margin_m=0.05
    )
    q = example.draw(panda, 400, np.random.default_rng(4))
    exact = np.array([reference_clearances(panda, row, exact_sdf).min() for row in q])
    starts, goals = q[exact > 0.06][:8], q[exact < -0.05][:8]

    def run(filtered):
        def path(field, start, goal):
            def step(q, _):
                wish = jnp.clip(5 * (goal - q), -0.6, 0.6)
                q = q + 0.02 * (safe(field, q, wish) if filtered else wish)
                return q, q

            return jax.lax.scan(step, start, length=250)[1][::5]

        paths = jax.jit(jax.vmap(path, (None, 0, 0)))(field, starts, goals)
        clearances = [
            min(reference_clearances(panda, row, exact_sdf).min() for row in np.asarray(path))
            for path in paths
        ]
        return np.array(clearances)

    assert (run(filtered=False) < 0).sum() >= 5
    assert run(filtered=True).min() > 0.0


def test_bad_arguments_are_refused(panda):
    field = half_space([0, 0, 1.0], 0.0)
    with pytest.raises(ValueError, match=r"q has shape \(6,\), expected \(..., 7\)"):
        planning.frax.arm_clearance(field, panda, np.zeros(6))
    with pytest.raises(ValueError, match=r"pose_world_base has shape \(3, 4\)"):
        planning.frax.arm_clearance(field, panda, np.zeros(7), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="unknown"):
        planning.frax.arm_clearance(field, panda, np.zeros(7), None, "space")
