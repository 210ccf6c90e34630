"""The kernel for the loss's gradient, interpreted on a CPU, against autodiff and numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_siren import BOUNDS, interpret_kernels, numpy_forward, numpy_gradient, some_samples

import hiosdf_jax as hio
from hiosdf_jax._src.network import derivatives, loss, siren, training
from hiosdf_jax._src.numerics import devices

pytest.importorskip("jax.experimental.pallas.mosaic_gpu")


# Compiled as wholes: one operation after another compiles each for itself. Interpreted kernels
# are not: they compute with JAX in callbacks, and can wait forever inside another program.
init_params = jax.jit(siren.init_params, static_argnums=0)
weights_of = jax.jit(loss.weights, static_argnums=0)
gradient_by_xla = jax.jit(derivatives._by_xla, static_argnums=0)


@pytest.fixture
def interpreted(monkeypatch):
    """Runs the kernel on the CPU, on two multiprocessors, for any number of rows."""
    interpret_kernels(monkeypatch, multiprocessors=2)
    monkeypatch.setattr(derivatives, "_LEAST_ROWS", 1)


def problem(layers, rows, every):
    config = hio.Config.default(BOUNDS, hidden_layers=layers, eikonal_every=every)
    params, samples = init_params(config, jax.random.key(layers)), some_samples(rows)
    return config, params, samples.points_world, samples, weights_of(config, samples)


def relative(result, exact):
    return np.linalg.norm(np.asarray(result, np.float64) - exact) / np.linalg.norm(exact)


@pytest.mark.parametrize(("layers", "rows", "every"), [(4, 300, 1), (2, 600, 3), (1, 128, 128)])
def test_the_gradient_is_that_of_autodiff(interpreted, layers, rows, every):
    config, *arguments = problem(layers, rows, every)
    gradient, sums = derivatives.loss_gradient(config, *arguments)
    exact, exact_sums = gradient_by_xla(config, *arguments)
    assert jax.tree.structure(gradient) == jax.tree.structure(exact)
    for result, expected in zip(jax.tree.leaves(gradient), jax.tree.leaves(exact), strict=True):
        assert result.shape == expected.shape
        assert relative(result, expected) < 3e-3
    np.testing.assert_allclose(sums, exact_sums, rtol=1e-3)


def test_the_gradient_is_that_of_finite_differences(interpreted):
    config, params, points, samples, weights = problem(2, 300, 2)
    gradient, _ = derivatives.loss_gradient(config, params, points, samples, weights)
    sloped = loss.sloped_rows(config, samples)

    def total(shift):
        moved = jax.tree.map(lambda p, g: np.float64(p) + shift * np.float64(g), params, gradient)
        value = numpy_forward(config, moved, points)
        slope = np.linalg.norm(numpy_gradient(config, moved, points[:sloped]), axis=1)
        weight = np.asarray(samples.weight, np.float64)
        sdf = np.sum(np.abs(value - samples.sdf) * weight) * config.sdf_weight
        eikonal = np.sum(np.abs(slope - 1) * weight[:sloped]) * config.eikonal_weight
        return sdf + eikonal * weights.sdf / weights.eikonal

    step = 1e-8
    along = (total(step) - total(-step)) / (2 * step)
    square = sum(float(np.sum(np.square(leaf))) for leaf in jax.tree.leaves(gradient))
    np.testing.assert_allclose(along, square, rtol=5e-3)


def test_rows_without_weight_change_nothing(interpreted):
    config, params, points, samples, weights = problem(1, 200, 1)
    unused = samples._replace(weight=samples.weight.at[150:].set(0))
    weights = weights_of(config, unused)
    first = jax.tree.map(lambda array: array[:150], unused)
    moved = unused._replace(sdf=unused.sdf.at[150:].add(5.0))
    results = [
        derivatives.loss_gradient(config, params, points[: s.sdf.shape[0]], s, weights)[0]
        for s in (unused, first, moved)
    ]
    for other in results[1:]:
        for a, b in zip(jax.tree.leaves(results[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4 * np.max(np.abs(a)))


def test_several_networks_at_once_are_left_to_xla(interpreted):
    config, params, points, samples, weights = problem(1, 64, 2)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, 1.1 * leaf]), params)

    def function(params):
        return derivatives.loss_gradient(config, params, points, samples, weights)

    assert "callback" not in str(jax.make_jaxpr(jax.vmap(function))(both))
    gradients, _ = jax.jit(jax.vmap(function))(both)
    for index in range(2):
        one = jax.tree.map(lambda leaf, index=index: leaf[index], (both, gradients))
        exact, _ = gradient_by_xla(config, one[0], points, samples, weights)
        for result, expected in zip(jax.tree.leaves(one[1]), jax.tree.leaves(exact), strict=True):
            assert relative(result, expected) < 1e-4


def test_the_gradient_is_constant_under_differentiation(interpreted):
    config, params, points, samples, weights = problem(1, 64, 2)

    def total(points):
        gradient, _ = derivatives.loss_gradient(config, params, points, samples, weights)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(gradient))

    np.testing.assert_array_equal(jax.grad(total)(points), 0)


@pytest.mark.parametrize(
    ("width", "least", "platform", "chosen"),
    [
        (128, 1, "cuda", True),
        (128, 1, "cpu", False),
        (128, 8192, "cuda", False),  # on a CPU, samples come in tiles of fewer rows
        (256, 1, "cuda", False),
    ],
)
def test_training_chooses_by_network_and_device(monkeypatch, width, least, platform, chosen):
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    monkeypatch.setattr(derivatives, "_LEAST_ROWS", least)
    config = hio.Config.default(BOUNDS, hidden_width=width, hidden_layers=1)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(512)
    program = jax.jit(lambda *arguments: training.train(config, *arguments))
    traced = program.trace(network, samples, jnp.int32(0), jnp.float32(0), jax.random.key(0))
    assert ("mosaic_gpu" in traced.lower(lowering_platforms=(platform,)).as_text()) == chosen
