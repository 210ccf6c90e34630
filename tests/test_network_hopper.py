"""The kernel for Hopper GPUs, interpreted on a CPU, against numpy in float64, and its choice."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_siren import BOUNDS, interpret_kernels, numpy_forward, numpy_gradient

import hiosdf_jax as hio
from hiosdf_jax._src.network import evaluation, siren
from hiosdf_jax._src.numerics import devices

pytest.importorskip("jax.experimental.pallas.mosaic_gpu")


# Compiled as wholes: one operation after another compiles each for itself.
init_params = jax.jit(siren.init_params, static_argnums=0)


def network(width, layers):
    config = hio.Config.default(BOUNDS, hidden_width=width, hidden_layers=layers)
    return config, init_params(config, jax.random.key(width + layers))


def points_of(rows):
    return np.random.default_rng(rows).uniform(-5, 5, (rows, 3)).astype(np.float32)


def relative(result, exact):
    return np.linalg.norm(np.asarray(result, np.float64) - exact) / np.linalg.norm(exact)


@pytest.fixture
def interpreted(monkeypatch):
    """Runs the kernel on the CPU, on one multiprocessor, for any number of rows."""
    interpret_kernels(monkeypatch, multiprocessors=1)
    monkeypatch.setattr(evaluation, "_LEAST_ROWS", 1)


@pytest.mark.parametrize(("width", "layers", "rows"), [(128, 4, 200), (128, 1, 100), (256, 2, 65)])
def test_values_and_gradients(interpreted, width, layers, rows):
    config, params = network(width, layers)
    points = points_of(rows)
    value, gradient = siren.predict_with_gradient(config, params, points)
    assert relative(value, numpy_forward(config, params, points)) < 2e-3
    assert relative(gradient, numpy_gradient(config, params, points)) < 2e-3


def test_derivatives_and_batches(interpreted):
    config, params = network(128, 1)
    points = points_of(300).reshape(2, 150, 3)
    value, gradient = siren.predict_with_gradient(config, params, points)
    by_grad = jax.grad(lambda x: siren.predict(config, params, x).sum())(points)
    np.testing.assert_allclose(by_grad, gradient, atol=1e-6)
    one = jax.vmap(jax.vmap(lambda x: siren.predict(config, params, x)))
    np.testing.assert_allclose(one(points), value, atol=1e-6)
    each = jax.vmap(jax.vmap(jax.value_and_grad(lambda x: siren.predict(config, params, x))))
    np.testing.assert_allclose(each(points)[1], gradient, atol=1e-6)


def test_several_networks_at_once_are_left_to_xla(interpreted):
    config, first = network(128, 2)
    second = jax.tree.map(lambda leaf: 1.1 * leaf, first)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, second)
    points = points_of(4)
    predict = jax.vmap(functools.partial(siren.predict_with_gradient, config), (0, None))
    value, gradient = jax.jit(predict)(both, points)
    for index, params in enumerate([first, second]):
        assert relative(value[index], numpy_forward(config, params, points)) < 1e-4
        assert relative(gradient[index], numpy_gradient(config, params, points)) < 1e-3


def test_the_device_is_chosen_when_the_program_is_compiled(monkeypatch):
    config, params = network(128, 4)

    def has_kernel(platform):
        program = jax.jit(lambda p, x: siren.predict_with_gradient(config, p, x))
        traced = program.trace(params, jax.ShapeDtypeStruct((8192, 3), jnp.float32))
        return "mosaic_gpu" in traced.lower(lowering_platforms=(platform,)).as_text()

    monkeypatch.setattr(evaluation, "_LEAST_ROWS", 1)  # on a CPU, points come in tiles
    assert not devices.has_kernels()
    assert not has_kernel("cuda")
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    assert has_kernel("cuda")
    assert not has_kernel("cpu")


@pytest.mark.parametrize(("width", "layers"), [(100, 2), (512, 4), (128, 9)])
def test_other_networks_are_left_to_xla(monkeypatch, width, layers):
    monkeypatch.setattr(evaluation, "_LEAST_ROWS", 1)
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    config, params = network(width, layers)
    program = jax.jit(lambda p, x: siren.predict(config, p, x))
    shape = jax.ShapeDtypeStruct((8192, 3), jnp.float32)
    lowered = program.trace(params, shape).lower(lowering_platforms=("cuda",))
    assert "mosaic_gpu" not in lowered.as_text()


def test_few_points_are_left_to_xla(monkeypatch):
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    config, params = network(128, 1)
    program = jax.jit(lambda p, x: siren.predict(config, p, x))
    shape = jax.ShapeDtypeStruct((100, 3), jnp.float32)
    assert (
        "mosaic_gpu"
        not in program.trace(params, shape).lower(lowering_platforms=("cuda",)).as_text()
    )


def test_an_untried_jax_is_left_to_xla(monkeypatch):
    class Hopper:
        compute_capability = "9.0"

    monkeypatch.setattr(jax, "devices", lambda: [Hopper()])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert devices.has_kernels() == (jax.__version_info__ < (0, 13))
    monkeypatch.setattr(jax, "__version_info__", (0, 13, 0))
    assert not devices.has_kernels()
    monkeypatch.setattr(jax, "__version_info__", (0, 12, 0))
    monkeypatch.setattr(Hopper, "compute_capability", "8.0")
    assert not devices.has_kernels()
    monkeypatch.setattr(Hopper, "compute_capability", "9.0")
    monkeypatch.setattr(jax, "devices", lambda: [Hopper(), Hopper()])
    assert not devices.has_kernels()
