"""The fast sine and the SIREN against numpy in float64."""

import jax
import numpy as np
import pytest
from plain_siren import BOUNDS, TINY, numpy_forward, numpy_gradient

import hiosdf_jax as hio
from hiosdf_jax._src.network import siren
from hiosdf_jax._src.network.fast_sine import cosine, sine


def test_sine_and_its_derivatives():
    x = np.linspace(-10, 10, 20_001, dtype=np.float32)
    exact = x.astype(np.float64)
    assert np.abs(sine(x) - np.sin(exact)).max() < 1e-6
    assert np.abs(cosine(x) - np.cos(exact)).max() < 1e-6
    first = jax.vmap(jax.grad(sine))(x)
    second = jax.vmap(jax.grad(jax.grad(sine)))(x)
    assert np.abs(first - np.cos(exact)).max() < 1e-6
    assert np.abs(second + np.sin(exact)).max() < 1e-6
    far = np.linspace(-300, 300, 10_001, dtype=np.float32)
    assert np.abs(sine(far) - np.sin(far.astype(np.float64))).max() < 3e-5
    np.testing.assert_allclose(jax.jit(sine)(x), sine(x), atol=3e-7)


def test_the_paper_s_network():
    config = hio.Config.paper(BOUNDS)
    params = siren.init_params(config, jax.random.key(0))
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == 264_449
    for k, inputs in enumerate([3, 256, 256, 256, 256, 256]):
        layer = params["params"][f"Dense_{k}"]
        bound = (6 / inputs) ** 0.5 / 10
        for leaf in jax.tree.leaves(layer):
            assert np.abs(leaf).max() <= bound
        kernel = np.asarray(layer["kernel"])
        np.testing.assert_allclose(kernel.std(), bound / 3**0.5, rtol=0.1)
    points = np.random.default_rng(1).uniform(-5, 5, (50, 3)).astype(np.float32)
    value, gradient = siren.predict_with_gradient(config, params, points)
    np.testing.assert_allclose(value, numpy_forward(config, params, points), atol=2e-5)
    np.testing.assert_allclose(gradient, numpy_gradient(config, params, points), atol=2e-4)


def test_vmap_over_points_takes_the_memory_of_a_batch():
    """A planner is written for one point, and batched by `jax.vmap`."""
    params = siren.init_params(TINY, jax.random.key(0))
    points = np.random.default_rng(3).uniform(-1, 1, (40_000, 3)).astype(np.float32)

    def of_point(params, point):
        return jax.value_and_grad(lambda x: siren.predict(TINY, params, x))(point)

    def of_rows(params, points):
        return siren.predict_with_gradient(TINY, params, points)

    nested = jax.vmap(jax.vmap(of_point, (None, 0)), (None, 0))
    single = jax.jit(jax.vmap(of_point, (None, 0))).lower(params, points).compile()
    tiled = jax.jit(nested).lower(params, points.reshape(40, 1000, 3)).compile()
    batch = jax.jit(of_rows).lower(params, points).compile()
    assert np.abs(single(params, points)[1] - batch(params, points)[1]).max() < 1e-4
    most = 1.05 * batch.memory_analysis().temp_size_in_bytes
    assert single.memory_analysis().temp_size_in_bytes <= most
    assert tiled.memory_analysis().temp_size_in_bytes <= most


@pytest.mark.parametrize("rows", [32_769, 40_000])
def test_eager_equals_jit_equals_vmap(rows):
    params = siren.init_params(TINY, jax.random.key(0))
    points = np.random.default_rng(2).uniform(-1, 1, (rows, 3)).astype(np.float32)
    eager = siren.predict_with_gradient(TINY, params, points)
    jitted = jax.jit(lambda p, x: siren.predict_with_gradient(TINY, p, x))(params, points)
    single = jax.jit(jax.vmap(lambda x: siren.predict_with_gradient(TINY, params, x)))(points)
    for other in (jitted, single):
        np.testing.assert_allclose(other[0], eager[0], atol=1e-5)
        np.testing.assert_allclose(other[1], eager[1], atol=1e-4)
