"""Training against the paper's equations, AdamW and numpy in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from plain_siren import (
    BOUNDS,
    TINY,
    mean_losses,
    numpy_forward,
    numpy_gradient,
    some_samples,
)

import hiosdf_jax as hio
from hiosdf_jax._src.network import forward, siren, tiles, training


def compiled_train():
    """Makes a compiled `train` of its own, so that it uses what a test has patched before."""
    compiled = jax.jit(lambda *arguments: training.train(*arguments), static_argnums=0)

    def train(config, network, samples, epochs, average=0.0, seed=0):
        config = dataclasses.replace(config, epochs=min(config.epochs, epochs))
        extra = jnp.int32(epochs - training.least_epochs(config))
        return compiled(config, network, samples, extra, jnp.float32(average), jax.random.key(seed))

    return train


train = compiled_train()


@pytest.mark.parametrize("every", [1, 3])
def test_losses_are_equations_4_and_5(every):
    config = hio.Config.light(BOUNDS, hidden_width=8, hidden_layers=1, eikonal_every=every)
    params, samples = siren.init_params(config, jax.random.key(0)), some_samples()
    losses = jax.jit(mean_losses, static_argnums=0)
    result = losses(config, params, samples.points_world, samples)
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
        parts = mean_losses(TINY, params, points, samples)
        return TINY.sdf_weight * parts.sdf + TINY.eikonal_weight * parts.eikonal

    gradients = jax.jit(jax.grad(objective))(network.params)
    # The first step of Adam is lr * g / (|g| + eps), after the decay of the weights (AdamW).
    for new, old, g in zip(
        *(jax.tree.leaves(tree) for tree in (trained.params, network.params, gradients)),
        strict=True,
    ):
        g, old = np.asarray(g, np.float64), np.asarray(old, np.float64)
        step = g / (np.abs(g) + 1e-8) + TINY.weight_decay * old
        np.testing.assert_allclose(new, old - TINY.learning_rate * step, atol=2e-6)


def test_training_fits_and_the_average_has_no_bias():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    first = train(TINY, network, samples, 1)[1]
    trained, last, _ = train(TINY, network, samples, 400)
    assert float(last.sdf) < 0.2 * float(first.sdf)
    points = samples.points_world - trained.origin_world
    residual = siren.predict(TINY, trained.average, points) - samples.sdf
    assert abs(np.median(np.asarray(residual)[np.asarray(samples.weight) > 0])) < 1e-6


def test_epochs_and_batches_count_the_steps():
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


def test_each_group_has_samples_of_all_depths():
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
def test_each_slope_counts_once_in_every_few_epochs(monkeypatch, every, tile):
    monkeypatch.setattr(tiles, "LARGEST", tile)
    train = compiled_train()
    config = dataclasses.replace(TINY, eikonal_every=every, eikonal_weight=0.3, learning_rate=0.02)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(64)
    optimizer = optax.adamw(config.learning_rate, weight_decay=config.weight_decay)
    params, state = network.params, optimizer.init(network.params)
    points = samples.points_world - network.origin_world
    order = training._order(config, 64, jax.random.key(1))
    place = np.argsort(order) // (64 // tile if tile < 64 else 1)  # distributed like cards

    def objective(params, chosen):
        model = siren.network_of(config)
        value = jax.vmap(lambda point: model.apply(params, point))(points)
        gradient = jax.vmap(jax.grad(lambda point: model.apply(params, point)))(points)
        error, slope = jnp.abs(value - samples.sdf), jnp.linalg.norm(gradient, axis=-1)
        sdf = jnp.average(error, weights=samples.weight)
        eikonal = jnp.average(jnp.abs(slope - 1), weights=samples.weight * chosen)
        return config.sdf_weight * sdf + config.eikonal_weight * eikonal, (sdf, eikonal)

    @jax.jit
    def step(params, state, chosen):
        gradients, expected = jax.grad(objective, has_aux=True)(params, chosen)
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), state, expected

    for epoch in range(2 * every):
        params, state, expected = step(params, state, place % every == epoch % every)
        trained, parts, _ = train(config, network, samples, epoch + 1)
        np.testing.assert_allclose(parts, expected, rtol=2e-4)
    for a, b in zip(jax.tree.leaves(trained.params), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)


# With slopes of all samples no epoch depends on its number: fewer cases are enough.
@pytest.mark.parametrize("device", ["cpu", "gpu"])
@pytest.mark.parametrize(
    ("every", "epochs", "warmup_epochs"),
    [(3, 5, 5), (3, 2, 5), (3, 5, 2), (3, 2, 1), (3, 1, 50), (1, 2, 5), (1, 1, 50)],
)
def test_extra_epochs_are_like_all_others(monkeypatch, device, every, epochs, warmup_epochs):
    tiny = dataclasses.replace(TINY, eikonal_every=every)
    network, samples = training.init_network(tiny, jax.random.key(0)), some_samples(72)
    expected, expected_parts, _ = train(
        dataclasses.replace(tiny, epochs=5, warmup_epochs=5), network, samples, 5
    )
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    monkeypatch.setattr(forward, "stored_dtype", lambda: jnp.float32)
    config = dataclasses.replace(tiny, epochs=epochs, warmup_epochs=warmup_epochs)
    trained, parts, _ = compiled_train()(config, network, samples, 5)
    assert int(trained.optimizer[0].count) == 5
    np.testing.assert_allclose(parts, expected_parts, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(trained), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("every", [1, 3])
def test_a_step_in_tiles_equals_a_step(monkeypatch, every):
    config = dataclasses.replace(TINY, eikonal_every=every)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(70)
    if every == 1:
        whole, *_ = train(config, network, samples, 1)
    monkeypatch.setattr(tiles, "LARGEST", 16)
    batch = jax.tree.map(
        lambda array: array[0], training._split(config, samples, jax.random.key(0))
    )
    assert batch.sdf.shape == (5, 14)
    tiled, parts, _ = compiled_train()(config, network, samples, 1)
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
def test_the_padding_of_a_tile_on_a_gpu_changes_nothing(monkeypatch, every):
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
    assert tiles.tile_index(60_000, 1000).shape == (
        1,
        60_000,
    )  # too much padding
    monkeypatch.setattr(tiles, "_MOST_PADDING", 20)
    batch = training._split(config, samples, jax.random.key(0))
    assert batch.sdf.shape == (1, 1, 256 * every)
    padded, padded_losses, _ = compiled_train()(config, network, samples, 2)
    np.testing.assert_allclose(padded_losses, losses, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(padded), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_small_gradients_survive_in_float16(monkeypatch):
    """As on a GPU: a sample's share of a mean would be lost among the smallest numbers."""
    config = dataclasses.replace(TINY, sdf_weight=1e-3, eikonal_weight=1e-3)
    network, samples = training.init_network(config, jax.random.key(0)), some_samples(900)
    exact = train(config, network, samples, 1)[0].optimizer[0].mu
    monkeypatch.setattr(forward, "stored_dtype", lambda: jnp.float16)
    rounded = compiled_train()(config, network, samples, 1)[0].optimizer[0].mu
    for a, b in zip(jax.tree.leaves(rounded), jax.tree.leaves(exact), strict=True):
        assert np.linalg.norm(a - b) < 0.02 * np.linalg.norm(b)


def test_the_average_is_between_old_and_new_weights():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    trained, *_ = train(TINY, network, samples, 5, average=0.75)
    old, new, average = (
        np.asarray(tree["params"]["Dense_0"]["kernel"])
        for tree in (network.average, trained.params, trained.average)
    )
    np.testing.assert_allclose(average, 0.75 * old + 0.25 * new, atol=1e-6)


def test_a_sample_that_is_not_finite_leaves_the_network_as_it_was():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    broken = samples._replace(sdf=samples.sdf.at[7].set(jnp.nan))
    after, _, finite = train(TINY, network, broken, 3)
    assert not bool(finite)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(network), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_optimizer_that_is_not_finite_starts_anew():
    network, samples = training.init_network(TINY, jax.random.key(0)), some_samples()
    network, *_ = train(TINY, network, samples, 3)
    adam, *rest = network.optimizer
    spoiled = jax.tree.map(lambda leaf: leaf.at[..., 0].set(jnp.inf), adam.nu)
    broken = network.replace(optimizer=(adam._replace(nu=spoiled), *rest))
    after, _, finite = train(TINY, broken, samples, 3)
    assert not bool(finite)
    fresh = training.init_network(TINY, jax.random.key(1)).optimizer
    for a, b in zip(
        jax.tree.leaves(after), jax.tree.leaves(network.replace(optimizer=fresh)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    healed, _, finite = train(TINY, after, samples, 3)
    assert bool(finite)
    assert not np.array_equal(*(jax.tree.leaves(each.params)[0] for each in (healed, network)))


def test_the_schedule_warms_up_and_queries_never_use_the_untrained_network():
    config = dataclasses.replace(TINY, warmup_updates=3, warmup_epochs=7, epochs=2)
    config = dataclasses.replace(config, weight_average=0.8)
    made = [training.schedule(config, jnp.int32(n), jnp.float32(0.019)) for n in range(7)]
    assert [int(extra) for extra, _ in made] == [5, 5, 5, 0, 0, 0, 0]
    short = dataclasses.replace(config, warmup_epochs=1)
    assert [int(training.schedule(short, jnp.int32(n), jnp.float32(0))[0]) for n in (2, 3)] == [
        0,
        1,
    ]
    expected = [0, 1 / 2, 2 / 3, 3 / 4, 4 / 5, 0.8, 0.8]
    np.testing.assert_allclose([float(average) for _, average in made], expected, atol=1e-6)
    # A changed world: old weights count less.
    changed = [float(training.schedule(config, jnp.int32(n), 0.02)[1]) for n in (0, 1, 2, 6)]
    np.testing.assert_allclose(changed, [0, 0.5, 0.5, 0.5], atol=1e-6)


def test_the_median_of_residuals_is_numpy_s():
    rng = np.random.default_rng(4)
    for count in (1, 2, 3, 50, 101):
        for digits in (1, 6):  # with and without ties
            values = np.round(rng.normal(size=count), digits).astype(np.float32)
            weight = (rng.random(count) < 0.7).astype(np.float32)
            expected = np.median(values[weight > 0]) if weight.any() else 0
            assert training._median(jnp.asarray(values), jnp.asarray(weight)) == expected
    values, weight = jnp.array([3.0, -2.0, 5.0, 1.0, 9.0]), jnp.array([1.0, 1.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(jax.grad(training._median)(values, weight), [0.5, 0, 0, 0.5, 0])
