"""A function of rows: the same result and derivatives in tiles, batches and transforms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hiosdf_jax._src.numerics import point_tiles
from hiosdf_jax._src.numerics.barriers import compute_once
from hiosdf_jax._src.numerics.gradient import value_and_gradient
from hiosdf_jax._src.numerics.point_tiles import by_rows

FIELD = {"center": jnp.asarray([0.3, -0.2, 0.5]), "count": jnp.asarray(3)}
POINTS = jax.random.normal(jax.random.key(0), (50, 3))


def distance(field, points):
    inner = compute_once(points - field["center"])
    return jnp.sqrt(jnp.sum(inner**2, axis=-1)) + jnp.sin(points[..., 0]) * field["count"]


def with_gradient(field, points):
    return value_and_gradient(lambda points: distance(field, points), points)


@pytest.fixture(params=[False, True], ids=["plain", "with_gradient"], autouse=True)
def tiled(request, monkeypatch):
    monkeypatch.setattr(point_tiles, "_LARGEST", 16)
    return by_rows(distance, with_gradient if request.param else None)


def close(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, expected)


def test_batches_equal_single_points(tiled):
    expected = distance(FIELD, POINTS)
    close(tiled(FIELD, POINTS), expected)
    close(jax.jit(tiled)(FIELD, POINTS), expected)
    close(jnp.stack([tiled(FIELD, point) for point in POINTS[:5]]), expected[:5])
    close(jax.vmap(tiled, (None, 0))(FIELD, POINTS), expected)
    nested = jax.vmap(jax.vmap(tiled, (None, 0)), (None, 1))(FIELD, POINTS.reshape(10, 5, 3))
    close(nested, expected.reshape(10, 5).T)
    assert tiled(FIELD, POINTS[:0]).shape == (0,)


def test_batches_share_the_tiles_of_one_call(tiled):
    """Whoever writes a planner for one point gets the program of a batch."""
    batched = str(jax.make_jaxpr(jax.vmap(tiled, (None, 0)))(FIELD, POINTS))
    assert "f32[4,13,3]" in batched and "f32[4,13,3]" in str(jax.make_jaxpr(tiled)(FIELD, POINTS))


def test_several_fields(tiled):
    fields = {"center": jnp.stack([FIELD["center"], -FIELD["center"]]), "count": jnp.asarray(3)}
    axes = {"center": 0, "count": None}
    for points, axis in ((POINTS, None), (POINTS.reshape(2, 25, 3), 0)):
        found = jax.vmap(tiled, (axes, axis))(fields, points)
        close(found, jax.vmap(distance, (axes, axis))(fields, points))


def test_derivatives(tiled):
    def total(function):
        return lambda center, points: jnp.sum(function(FIELD | {"center": center}, points) ** 2)

    given = FIELD["center"], POINTS
    for argument in (0, 1, (0, 1)):
        found, expected = (jax.jit(jax.grad(total(f), argument))(*given) for f in (tiled, distance))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), found, expected)
    point = POINTS[0]
    for transform in (jax.grad, jax.jacfwd, jax.hessian):
        found, expected = (transform(lambda p, f=f: f(FIELD, p)) for f in (tiled, distance))
        close(jax.jit(found)(point), jax.jit(expected)(point))
        close(jax.jit(jax.vmap(found))(POINTS), jax.jit(jax.vmap(expected))(POINTS))

    def along(function):
        return jax.jit(lambda p: jax.jvp(lambda p: function(FIELD, p), (p,), (jnp.ones_like(p),)))

    close(along(tiled)(POINTS), along(distance)(POINTS))


def test_whole_numbers_of_a_field_have_no_derivative(tiled):
    def of_field(field):
        return jnp.sum(tiled(field, POINTS))

    found = jax.grad(of_field, allow_int=True)(FIELD)
    assert found["count"].dtype == jax.dtypes.float0
    close(found["center"], jax.grad(lambda c: of_field(FIELD | {"center": c}))(FIELD["center"]))
