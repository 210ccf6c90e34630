"""The clearance of a body's spheres and its Jacobian, against exact distances in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analytic import count_traces, half_space, half_spaces

from hiosdf_jax import planning
from hiosdf_jax._src.planning import body as module

LINKS, RADII = np.array([0.6, 0.5, 0.4]), np.array([0.1, 0.08, 0.06])


def chain(q, xp=jnp):
    """Three balls on a chain in the plane y = 0, (S, 3) m and (S,) m."""
    angles = xp.cumsum(q)
    steps = LINKS[:, None] * xp.stack([xp.cos(angles), 0 * angles, xp.sin(angles)], axis=1)
    return xp.cumsum(steps, axis=0), RADII


def exact(q, normal, offset):
    """(S,) m, float64."""
    centers, radii = chain(np.asarray(q, float), np)
    return centers @ normal + offset - radii


def test_value_and_jacobian_of_100_maps_with_one_compilation():
    counted, traces = count_traces(
        lambda field, q: planning.clearance_and_jacobian(field, chain, q)
    )
    compiled = jax.jit(counted)
    poses = np.random.default_rng(0).uniform(-3, 3, (100, 3)).astype(np.float32)
    step = 1e-6 * np.eye(3)
    for q, normal, offset, field in zip(poses, *half_spaces(100), strict=True):
        clearance, jacobian = compiled(field, q)
        np.testing.assert_allclose(clearance, exact(q, normal, offset), atol=1e-5)
        sides = [exact(q + e, normal, offset) - exact(q - e, normal, offset) for e in step]
        np.testing.assert_allclose(jacobian, np.stack(sides, axis=1) / 2e-6, atol=1e-5)
    assert len(traces) == 1


def test_the_map_is_queried_once(monkeypatch):
    calls = []
    query = module.sphere_clearance_and_grad
    monkeypatch.setattr(
        module, "sphere_clearance_and_grad", lambda *a: calls.append(a[1].shape) or query(*a)
    )
    planning.clearance_and_jacobian(half_space([0, 0, 1.0], 0.0), chain, jnp.zeros(3))
    assert calls == [(3, 3)]


def test_unseen_space_and_the_lower_bound():
    field = half_space([1.0, 0, 0], 6.0)  # a wall at x = -6 m
    field = field.replace(
        frontier=half_space([0, 0, 1.0], 2.0).sdf, lower=half_space([1.0, 0, 0], 3.0).sdf
    )
    centers, radii = (np.asarray(part) for part in chain(jnp.zeros(3)))

    def measured(**options):
        return planning.clearance_and_jacobian(field, chain, jnp.zeros(3), **options)[0]

    np.testing.assert_allclose(measured(), 2 - radii, atol=1e-5)
    np.testing.assert_allclose(measured(unknown="network"), centers[:, 0] + 6 - radii, atol=1e-5)
    np.testing.assert_allclose(
        measured(unknown="network", bound="lower"), centers[:, 0] + 3 - radii, atol=1e-5
    )


def test_many_configurations_take_vmap():
    field = half_space([0, 0, 1.0], 0.5)
    many = jax.vmap(lambda q: planning.clearance_and_jacobian(field, chain, q))
    clearance, jacobian = many(jnp.zeros((4, 3)))
    assert clearance.shape == (4, 3) and jacobian.shape == (4, 3, 3)
    with pytest.raises(ValueError, match=r"q has shape \(4, 3\), expected \(n,\); use vmap"):
        planning.clearance_and_jacobian(field, chain, jnp.zeros((4, 3)))
