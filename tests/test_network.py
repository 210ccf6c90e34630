"""The sine, the SIREN and its training against plain numpy in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import hiosdf_jax as hio
from hiosdf_jax._src.network import forward, siren, tiles, training
from hiosdf_jax._src.network.fast_sine import cosine, sine
from hiosdf_jax._src.samples.draw import Samples

BOUNDS = ((-1, -1, -1), (1, 1, 1))
TINY = hio.Config.light(BOUNDS, hidden_width=8, hidden_layers=1, batches=1, eikonal_every=1)


def numpy_forward(config, params, points):
    layers = [params["params"][f"Dense_{k}"] for k in range(config.hidden_layers + 2)]
    x = np.asarray(points, np.float64)
    for layer in layers[:-1]:
        z = x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)
        x = np.sin(config.frequency * z)
    last = layers[-1]
    return (x @ np.asarray(last["kernel"], np.float64) + np.asarray(last["bias"], np.float64))[:, 0]


def numpy_gradient(config, params, points, step=1e-5):
    points = np.asarray(points, np.float64)
    return np.stack(
        [
            (
                numpy_forward(config, params, points + step * axis)
                - numpy_forward(config, params, points - step * axis)
            )
            / (2 * step)
            for axis in np.eye(3)
        ],
        axis=-1,
    )


def some_samples(count=64, seed=0):
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)
    return Samples(
        jnp.asarray(points),
        jnp.asarray(0.5 - np.linalg.norm(points, axis=1), jnp.float32),
        jnp.asarray(np.arange(count) % 5 > 0, jnp.float32),
    )


def train(config, network, samples, epochs, average=0.0, seed=0):
    config = dataclasses.replace(config, epochs=min(config.epochs, epochs))
    extra = jnp.int32(epochs - training.least_epochs(config))
    return training.train(
        config, network, samples, extra, jnp.float32(average), jax.random.key(seed)
    )


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


@pytest.mark.parametrize("every", [1, 3])
def test_losses_are_equations_4_and_5(every):
    config = hio.Config.light(BOUNDS, hidden_width=8, hidden_layers=1, eikonal_every=every)
    params, samples = siren.init_params(config, jax.random.key(0)), some_samples()
    result = training.losses(config, params, samples.points_world, samples)
    used = np.asarray(samples.weight) > 0
    value = numpy_forward(config, params, samples.points_world)
    slope = np.linalg.norm(numpy_gradient(config, params, samples.points_world), axis=1)
    np.testing.assert_allclose(result.sdf, np.abs(value - samples.sdf)[used].mean(), rtol=1e-4)
    chosen = np.arange(64) < -(-64 // every)
    np.testing.assert_allclose(result.eikonal, np.abs(slope - 1)[used & chosen].mean(), rtol=1e-3)


def test_one_step_is_adamw_on_equation_3():
    network = training.init_network(TINY, jax.random.key(0))
    samples = some_samples()
    trained, _, finite = train(TINY, network, samples, 1)
    assert bool(finite)
    points = samples.points_world - network.origin_world

    def objective(params):
        parts = training.losses(TINY, params, points, samples)
        return TINY.sdf_weight * parts.sdf + TINY.eikonal_weight * parts.eikonal

    gradients = jax.grad(objective)(network.params)
    # The first step of Adam is lr * g / (|g| + eps), after the decay of the weights (AdamW).
    for new, old, g in zip(
        *(jax.tree.leaves(tree) for tree in (trained.params, network.params, gradients)),
        strict=True,
    ):
        g, old = np.asarray(g, np.float64), np.asarray(old, np.float64)
        step = g / (np.abs(g) + 1e-8) + TINY.weight_decay * old
        np.testing.assert_allclose(new, old - TINY.learning_rate * step, atol=2e-6)


def test_training_fits_and_serves_without_a_bias():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples(256)
    first = train(TINY, network, samples, 1)[1]
    trained, last, _ = jax.jit(lambda n, s: train(TINY, n, s, 400))(network, samples)
    assert float(last.sdf) < 0.2 * float(first.sdf)
    points = samples.points_world - trained.origin_world
    residual = siren.predict(TINY, trained.average, points) - samples.sdf
    assert abs(np.median(np.asarray(residual)[np.asarray(samples.weight) > 0])) < 1e-6


def test_epochs_and_batches_are_honoured():
    config = hio.Config.light(BOUNDS, hidden_width=8, hidden_layers=1, batches=3)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(64)
    trained, *_ = train(config, network, samples, 4)
    assert int(trained.optimizer[0].count) == 12
    parts = training._split(config, samples, jax.random.key(1))
    assert parts.points_world.shape == (3, 1, 21, 3)
    rows = np.asarray(parts.points_world).reshape(-1, 3)
    assert len(np.unique(rows, axis=0)) == 63
    original = {tuple(row): s for row, s in zip(*map(np.asarray, samples[:2]), strict=True)}
    flat = np.asarray(parts.sdf).ravel()
    assert all(original[tuple(row)] == s for row, s in zip(rows, flat, strict=True))


def test_the_depths_of_a_ray_s_samples_are_in_all_groups():
    config = hio.Config.paper(BOUNDS, eikonal_every=4)
    count = config.near_samples + config.far_samples
    total = count + config.local_points * config.local_ray_samples
    group = np.argsort(training._order(config, total, jax.random.key(0))) % 4
    kinds = [group[: config.near_samples], group[config.near_samples : count]]
    kinds += list(group[count:].reshape(-1, config.local_ray_samples).T)
    for kind in kinds:  # five standard deviations
        deviation = np.sqrt(len(kind) * 3 / 16)
        assert np.abs(np.bincount(kind, minlength=4) - len(kind) / 4).max() < 5 * deviation


@pytest.mark.parametrize("tile", [1024, 16])
@pytest.mark.parametrize("every", [1, 2, 4])
def test_each_slope_counts_once_in_as_many_epochs(monkeypatch, every, tile):
    monkeypatch.setattr(tiles, "_ROWS", tile)
    config = dataclasses.replace(TINY, eikonal_every=every, eikonal_weight=0.3, learning_rate=0.02)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(64)
    optimizer = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    params, state = network.params, optimizer.init(network.params)
    points = samples.points_world - network.origin_world
    order = training._order(config, 64, jax.random.key(1))
    place = np.argsort(order) // (64 // tile if tile < 64 else 1)  # dealt to the tiles as cards
    for epoch in range(2 * every):
        chosen = place % every == epoch % every

        def objective(params, chosen=chosen):
            model = siren.network_of(config)
            value = jax.vmap(lambda point: model.apply(params, point))(points)
            gradient = jax.vmap(jax.grad(lambda point: model.apply(params, point)))(points)
            error, slope = jnp.abs(value - samples.sdf), jnp.linalg.norm(gradient, axis=-1)
            sdf = jnp.average(error, weights=samples.weight)
            eikonal = jnp.average(jnp.abs(slope - 1), weights=samples.weight * chosen)
            return config.sdf_weight * sdf + config.eikonal_weight * eikonal, (sdf, eikonal)

        gradients, expected = jax.grad(objective, has_aux=True)(params)
        updates, state = optimizer.update(gradients, state, params)
        params = optax.apply_updates(params, updates)
        trained, parts, _ = train(config, network, samples, epoch + 1)
        np.testing.assert_allclose(parts, expected, rtol=2e-4)
    for a, b in zip(jax.tree.leaves(trained.params), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)


@pytest.mark.parametrize("device", ["cpu", "gpu"])
@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize(("epochs", "warmup_epochs"), [(5, 5), (2, 5), (5, 2), (2, 1), (1, 50)])
def test_which_epochs_are_extra_changes_nothing(monkeypatch, device, every, epochs, warmup_epochs):
    tiny = dataclasses.replace(TINY, eikonal_every=every)
    network, samples = training.init_network(tiny, jax.random.key(0)), some_samples(72)
    expected, expected_parts, _ = train(
        dataclasses.replace(tiny, epochs=5, warmup_epochs=5), network, samples, 5
    )
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    monkeypatch.setattr(forward, "stored_dtype", lambda: jnp.float32)
    config = dataclasses.replace(tiny, epochs=epochs, warmup_epochs=warmup_epochs)
    trained, parts, _ = train(config, network, samples, 5)
    assert int(trained.optimizer[0].count) == 5
    np.testing.assert_allclose(parts, expected_parts, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(trained), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("every", [1, 3])
def test_a_step_by_tiles_is_a_step(monkeypatch, every):
    config = dataclasses.replace(TINY, eikonal_every=every)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(70)
    whole, *_ = train(config, network, samples, 1)
    monkeypatch.setattr(tiles, "_ROWS", 16)
    batch = jax.tree.map(
        lambda array: array[0], training._split(config, samples, jax.random.key(0))
    )
    assert batch.sdf.shape == (5, 14)
    tiled, parts, _ = train(config, network, samples, 1)
    sloped = -(-14 // every)
    points = batch.points_world - network.origin_world
    value = numpy_forward(config, network.params, points.reshape(-1, 3)).reshape(5, 14)
    slope = np.linalg.norm(numpy_gradient(config, network.params, points.reshape(-1, 3)), axis=1)
    error, used = np.abs(slope.reshape(5, 14) - 1)[:, :sloped], np.asarray(batch.weight) > 0
    np.testing.assert_allclose(parts.sdf, np.abs(value - batch.sdf)[used].mean(), rtol=1e-4)
    np.testing.assert_allclose(parts.eikonal, error[used[:, :sloped]].mean(), rtol=1e-3)
    if every == 1:  # otherwise the slopes of other samples are taken
        for a, b in zip(jax.tree.leaves(tiled), jax.tree.leaves(whole), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("every", [1, 3])
def test_the_padding_of_a_gpus_tile_changes_nothing(monkeypatch, every):
    config = dataclasses.replace(TINY, eikonal_every=every)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(72)
    plain, losses, _ = train(config, network, samples, 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(forward, "stored_dtype", lambda: jnp.float32)
    # Each share divides by 256: the 60,000 samples of the paper, the 42,000 of default.
    sizes = [(60_000, 1, 60_160), (60_000, 2, 60_416), (60_000, 4, 60_416), (42_000, 4, 43_008)]
    for rows, groups, size in sizes:
        assert tiles.tile_index(rows, groups).shape == (1, size)
        assert size % (256 * groups) == 0
    assert tiles.tile_index(60_000, 1000).shape == (1, 60_000)  # more padding than it is worth
    monkeypatch.setattr(tiles, "_MOST_PADDING", 20)
    batch = training._split(config, samples, jax.random.key(0))
    assert batch.sdf.shape == (1, 1, 256 * every)
    padded, padded_losses, _ = train(config, network, samples, 2)
    np.testing.assert_allclose(padded_losses, losses, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(padded), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_small_gradients_survive_in_float16(monkeypatch):
    """As on a GPU: a sample's share of a mean would be lost among the smallest numbers."""
    config = dataclasses.replace(TINY, sdf_weight=1e-3, eikonal_weight=1e-3)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(900)
    exact = train(config, network, samples, 1)[0].optimizer[0].mu
    monkeypatch.setattr(forward, "stored_dtype", lambda: jnp.float16)
    rounded = train(config, network, samples, 1)[0].optimizer[0].mu
    for a, b in zip(jax.tree.leaves(rounded), jax.tree.leaves(exact), strict=True):
        assert np.linalg.norm(a - b) < 0.02 * np.linalg.norm(b)


@pytest.mark.parametrize("rows", [0, 1, 16, 17, 50])
def test_tiles_are_all_rows(monkeypatch, rows):
    monkeypatch.setattr(tiles, "_ROWS", 16)
    dealt = tiles.tile_index(rows, 4)
    assert dealt.shape[1] <= 16 and dealt.size < rows + len(dealt) + 1
    assert sorted(dealt[dealt < rows]) == list(range(rows))
    points = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    sizes = []

    def function(rows):
        sizes.append(rows.shape[0])
        return rows[..., 0] * 2, rows + 1

    doubled, moved = tiles.map_tiles(function, jnp.asarray(points))
    np.testing.assert_array_equal(doubled, points[:, 0] * 2)
    np.testing.assert_array_equal(moved, points + 1)
    assert max(sizes) <= 16
    single = tiles.map_tiles(lambda rows: rows[..., 0], jnp.ones(3))
    assert single.shape == ()
    stacked = tiles.map_tiles(lambda rows: rows, jnp.asarray(points[:, None] + np.zeros((1, 7, 1))))
    np.testing.assert_allclose(stacked, np.broadcast_to(points[:, None], (rows, 7, 3)))


def test_the_average_is_of_old_and_new_weights():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    trained, *_ = train(TINY, network, samples, 5, average=0.75)
    old, new, served = (
        np.asarray(tree["params"]["Dense_0"]["kernel"])
        for tree in (network.average, trained.params, trained.average)
    )
    np.testing.assert_allclose(served, 0.75 * old + 0.25 * new, atol=1e-6)


def test_a_sample_that_is_not_finite_leaves_the_network_as_it_was():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    broken = samples._replace(sdf=samples.sdf.at[7].set(jnp.nan))
    after, _, finite = train(TINY, network, broken, 3)
    assert not bool(finite)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(network), strict=True):
        np.testing.assert_array_equal(a, b)
