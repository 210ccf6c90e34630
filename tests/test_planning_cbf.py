"""The safety filter: its quadratic program, corners, unseen space and reckless robots."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safety_filter as example
from analytic import baked, count_traces, half_space
from scene import ROOM, exact_sdf
from scipy.optimize import minimize

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from hiosdf_jax.planning import cbf

LIMITS = np.array([0.5, 1.0, 2.0])
MARGIN, GAIN = 0.05, 4.0
LINKS, RADII = np.array([0.6, 0.5, 0.4]), np.array([0.1, 0.08, 0.06])


def chain(q):
    """Three balls on a chain in the plane y = 0, (S, 3) m and (S,) m."""
    angles = jnp.cumsum(q)
    steps = LINKS[:, None] * jnp.stack([jnp.cos(angles), 0 * angles, jnp.sin(angles)], axis=1)
    return jnp.cumsum(steps, axis=0), RADII


def barriers(normal, offset, q):
    """The barriers of a half space in float64, which the filter keeps above zero, (S,) m."""
    angles = np.cumsum(np.asarray(q, float))
    steps = LINKS[:, None] * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    return np.cumsum(steps, axis=0) @ normal + offset - RADII - MARGIN


def nearest_safe(normal, offset, q, desired):
    """The expected velocity, by SLSQP on differenced barriers."""
    values = barriers(normal, offset, q)
    step = 1e-6 * np.eye(3)
    slopes = [barriers(normal, offset, q + e) - barriers(normal, offset, q - e) for e in step]
    slopes = np.stack(slopes, axis=1) / 2e-6
    found = minimize(
        lambda w: np.sum((w - desired / LIMITS) ** 2),
        np.zeros(3),
        bounds=[(-1, 1)] * 3,
        constraints={"type": "ineq", "fun": lambda w: slopes @ (LIMITS * w) + GAIN * values},
        options={"ftol": 1e-12, "maxiter": 200},
    )
    assert found.success
    return LIMITS * found.x


def test_it_returns_the_nearest_safe_velocity_and_compiles_once_for_200_maps():
    safe, traces = count_traces(
        cbf.velocity_filter(chain, LIMITS, margin_m=MARGIN, gain_per_s=GAIN)
    )
    controller = jax.jit(safe)
    rng = np.random.default_rng(1)
    q = rng.uniform(-3, 3, (200, 3)).astype(np.float32)
    wish = (rng.uniform(-1, 1, (200, 3)) * LIMITS).astype(np.float32)
    # Between the steps of a pair only the map changes.
    q[1::2], wish[1::2] = q[::2], wish[::2]
    answers, expected = np.zeros((2, 200, 3))
    for k in range(200):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        offset = rng.exponential(0.05) - barriers(normal, 0.0, q[k]).min()
        answers[k] = controller(half_space(normal, offset), q[k], wish[k])
        expected[k] = nearest_safe(normal, offset, q[k], wish[k])
    assert len(traces) == 1
    np.testing.assert_allclose(answers / LIMITS, expected / LIMITS, atol=0.03)
    assert (np.abs(expected - wish).max(axis=1) > 0.05).sum() > 15
    assert (np.abs(answers[::2] - answers[1::2]).max(axis=1) > 0.05).sum() > 15


@pytest.fixture(scope="module")
def ball():
    """A filter for a ball of 0.2 m, without margin."""
    safe = cbf.velocity_filter(lambda p: (p[None], np.array([0.2])), [1.0] * 3, margin_m=0.0)
    return jax.jit(safe)


def test_a_body_in_collision_leaves_at_its_velocity_limit(ball):
    wall = half_space([1.0, 0, 0], 0.0)  # solid where x < 0
    out = ball(wall, jnp.array([-1.0, 0, 0]), jnp.array([-1.0, 0, 0]))
    np.testing.assert_allclose(out, [1, 0, 0], atol=0.03)
    # 0.1 m too deep: dh/dt >= 0.5 m/s, and motion along the wall is free.
    out = ball(wall, jnp.array([0.1, 0, 0]), jnp.array([-1.0, 0.7, 0]))
    np.testing.assert_allclose(out, [0.5, 0.7, 0], atol=0.03)


def test_unseen_space_is_solid_by_default(ball):
    field = half_space([1.0, 0, 0], 6.0)  # the wall is at x = -6 m
    field = field.replace(frontier=half_space([1.0, 0, 0], 0.0).sdf)  # and x < 0 is unseen
    q, wish = jnp.array([0.2, 0.0, 0.0]), jnp.array([-0.8, 0.0, 0.0])
    np.testing.assert_allclose(ball(field, q, wish), 0, atol=0.01)
    bold = cbf.velocity_filter(
        lambda p: (p[None], np.array([0.2])), [1.0] * 3, margin_m=0.0, unknown="network"
    )
    np.testing.assert_allclose(jax.jit(bold)(field, q, wish), wish, atol=0.01)


def test_it_stops_where_the_solver_fails(ball):
    broken = half_space([1.0, 0, 0], 1.0)
    broken = broken.replace(sdf=broken.sdf * jnp.nan)
    np.testing.assert_array_equal(ball(broken, jnp.zeros(3), jnp.ones(3)), 0)


def test_inscribed_spheres_touch_theirs_from_inside():
    centers = np.random.default_rng(0).normal(size=(4, 3))
    radii = np.array([0.1, 0.2, 0.3, 0.4])
    more, sizes = cbf.inscribed(centers, radii, 0.25)
    assert more.shape == (28, 3)
    np.testing.assert_allclose(more[:4], centers, rtol=1e-6)
    inner = np.asarray(more[4:])
    owners = np.tile(np.arange(4), 6)
    np.testing.assert_allclose(sizes[4:], 0.25 * radii[owners], rtol=1e-6)
    apart = np.linalg.norm(inner - centers[owners], axis=1)
    np.testing.assert_allclose(apart + sizes[4:], radii[owners], rtol=1e-5)


def corner(points):
    """Solid where x < 0 or y < 0; exact inside of the room."""
    return np.minimum(points[..., 0], points[..., 1])


def test_in_a_corner_one_sphere_sinks_in_and_inscribed_ones_do_not(ball):
    field = baked(corner, [-0.4, -0.4, -0.2], [1.2, 1.2, 0.2], 0.02)
    seven = cbf.velocity_filter(
        lambda p: cbf.inscribed(p[None], np.array([0.2])), [1.0] * 3, margin_m=0.0
    )

    def least(safe):
        @jax.jit
        def path(field):
            def step(p, _):
                p = p + 0.05 * safe(field, p, jnp.array([-1.0, -1.0, 0.0]))
                return p, p

            return jax.lax.scan(step, jnp.array([0.6, 0.7, 0.0]), length=40)[1]

        return (corner(np.asarray(path(field), float)) - 0.2).min()

    assert least(ball) < -0.1
    assert least(seven) > -0.005


def test_the_filtered_robot_never_collides_where_the_reckless_one_does():
    field = baked(exact_sdf, ROOM[0] - 0.2, ROOM[1] + 0.2, 0.1)
    starts, goals = example.draw(150, np.random.default_rng(2), field)
    assert len(starts) == 150
    reckless, filtered = example.make_simulator()(field, starts, goals)
    assert (example.least_clearance(np.asarray(reckless, float)) < 0).mean() > 0.5
    assert example.least_clearance(np.asarray(filtered, float)).min() > 0.03
    # Where the straight line is clear, it arrives.
    clear = example.least_clearance(np.asarray(reckless, float)) > example.MARGIN + 0.02
    assert clear.sum() > 5
    arrived = np.linalg.norm(filtered[clear, -1] - goals[clear], axis=1)
    assert arrived.max() < 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity_limits": [1.0, 0.0]}, "velocity_limits"),
        ({"velocity_limits": 1.0}, "velocity_limits"),
        ({"margin_m": -0.1}, "margin_m"),
        ({"gain_per_s": np.nan}, "gain_per_s"),
    ],
)
def test_bad_numbers_are_refused(change, message):
    good = {"velocity_limits": [1.0] * 3, "margin_m": 0.1}
    with pytest.raises(ValueError, match=message):
        cbf.velocity_filter(chain, **(good | change))
    with pytest.raises(ValueError, match="share"):
        cbf.inscribed(np.zeros((1, 3)), [1.0], 1.0)
