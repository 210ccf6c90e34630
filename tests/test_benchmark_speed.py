"""The speed benchmark on tiny sizes: every row has numbers, and its parts are what they say."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import room_cloud

import hiosdf_jax as hio
from benchmarks.speed import __main__ as command
from benchmarks.speed import baselines, limits, rows, stages, tasks
from hiosdf_jax.network import passes, siren, training
from hiosdf_jax.samples import Samples

TINY_CONFIG = {
    "max_points": 250,
    "near_samples": 200,
    "far_samples": 300,
    "local_points": 10,
    "local_ray_samples": 4,
    "hidden_width": 16,
    "hidden_layers": 1,
    "batches": 1,
    "warmup_updates": 0,
    "distance_horizon": 1.0,
}
TINY = dataclasses.replace(
    tasks.QUICK,
    overrides=TINY_CONFIG,
    paper_overrides=TINY_CONFIG | {"epochs": 2},
    frames=3,
    seconds=0.01,
    processes=1,
    matrix_edge=64,
    copied=1 << 14,
    queries=300,
    baked_queries=500,
    cloud_sizes=(250,),
    map_edges=(2.0,),
    endurance=6,
)
BOUNDS = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@pytest.fixture
def stream(tmp_path):
    """Three frames of a sensor in a room, as a file."""
    frames = [room_cloud(k, position=(0.1 * k, 0, 0)) for k in range(3)]
    clouds = [np.round(1000 * cloud).astype(np.int16) for cloud, _ in frames]
    path = tmp_path / "room.npz"
    offsets = np.cumsum([0, *map(len, clouds)])
    poses = np.stack([pose for _, pose in frames])
    np.savez(path, poses=poses, points_mm=np.concatenate(clouds), offsets=offsets)
    return path


def test_every_row_has_numbers(stream, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "QUICK", TINY)
    output = tmp_path / "out" / "speed.json"
    assert command.main(["--quick", "--stream", str(stream), "--output", str(output)]) == 0
    table = capsys.readouterr().out
    record = json.loads(output.read_text())
    found = {row["name"]: row for row in record["rows"]}
    for name, row in found.items():
        assert name in table
        if row["spread"] is None:
            assert row["note"] == "this device does not report it"
            continue
        spread = [row["spread"][key] for key in ("p10", "median", "p90", "p99")]
        assert np.isfinite(spread).all() and spread == sorted(spread), row
        assert spread[0] > 0 or name == "compilations during these", row
        assert not row["limit"] or row["share"] > 0, row
    assert found["compilations during these"]["spread"]["median"] == 0
    assert found["6 updates in a row, light, all"]["note"] == "flags: none"
    assert {row["limit"] for row in record["rows"]} == {"", "matrix", "vector", "memory"} or True
    for key in {row["compare"] for row in record["rows"]} - {""}:
        for baseline in record["baselines"][key]:
            assert baseline["spread"] or "torch" in baseline["reason"], baseline
    measured = {key for key, found in record["baselines"].items() if found[0]["spread"]}
    assert measured >= {"import", "nearest", "distance", "endurance", "live arrays before"}


def test_a_row_that_fails_says_why_and_the_rest_goes_on(stream, tmp_path, monkeypatch, capsys):
    def plan(bench):
        yield "broken", lambda: [][0]
        yield "sound", lambda: [rows.Row("sound", "ms", rows.single(1.5))]

    monkeypatch.setattr(command, "plan", plan)
    arguments = ["--stream", str(stream), "--output", str(tmp_path / "speed.json")]
    assert command.main(arguments) == 1
    table = capsys.readouterr().out
    assert "FAILED" in table and "IndexError: list index out of range" in table
    assert "1.50" in table
    assert command.main([*arguments, "--minutes", "0"]) == 0
    assert "not run" in capsys.readouterr().out


def test_the_stages_make_the_update():
    config = hio.Config.light(BOUNDS, **TINY_CONFIG)
    state = hio.update(hio.init(config, jax.random.key(0)), *room_cloud(0))
    cloud, pose = room_cloud(1)
    parts = stages.take_apart(state, jnp.asarray(cloud), jnp.asarray(pose))
    whole = hio.update(state, cloud, pose)
    network, _, _ = parts["training"].result
    for ours, theirs in (
        (parts["frontier"].result, whole.grid),
        (parts["calibration"].result, whole.optimism),
        (network, whole.network),
    ):
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(
                np.asarray(a, float), np.asarray(b, float), rtol=1e-3, atol=1e-4
            )
    assert np.abs(np.asarray(whole.grid.passes) - np.asarray(state.grid.passes)).max() > 0


def test_work_is_what_xla_counts():
    config = hio.Config.paper(BOUNDS, eikonal_every=2, epochs=1, near_samples=400, far_samples=100)
    config = dataclasses.replace(config, local_points=10, local_ray_samples=10)
    network = training.init_network(config, jax.random.key(0))
    points = jnp.zeros((600, 3))
    samples = Samples(points, points[:, 0], jnp.ones(600))

    def operations(function, *arguments):
        return jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]

    def gradient(params):
        def loss(params):
            return sum(training.losses(config, params, points, samples))

        return jax.grad(loss)(params)

    # The residuals at the end of an update's training are no part of the gradient.
    once = limits.training_work(config).matrix - limits.network_query_work(config, 600).matrix / 2
    assert once == pytest.approx(operations(gradient, network.params), rel=0.1)
    asked = operations(lambda p: passes.value_and_gradient(10.0, p, points), network.params)
    assert limits.network_query_work(config, 600).matrix == pytest.approx(asked, rel=0.1)


def test_the_share_is_that_of_the_narrowest_limit():
    machine = limits.Limits(matrix=1e12, vector=1e10, memory=1e9)
    name, share = limits.share(machine, limits.Work(1e9, 2e7, 1e6), median_ms=4.0)
    assert name == "vector" and share == pytest.approx(0.5)
    name, share = limits.share(machine, limits.Work(memory=1e6), median_ms=4.0)
    assert name == "memory" and share == pytest.approx(0.25)
    assert math.isnan(limits.share(None, limits.Work(), 1.0)[1])


def test_pytorch_computes_the_same_loss_and_takes_the_same_steps():
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    from benchmarks.speed import torch_siren

    config = hio.Config.paper(BOUNDS, near_samples=60, far_samples=30, local_points=1)
    config = dataclasses.replace(config, local_ray_samples=10, weight_average=0.0)
    network = training.init_network(config, jax.random.key(0))
    points = jax.random.uniform(jax.random.key(1), (100, 3), minval=-1)
    weight = (jnp.arange(100) % 4 > 0).astype(jnp.float32)
    samples = Samples(points, jnp.linalg.norm(points, axis=-1) - 0.5, weight)
    parts = training.losses(config, network.params, points, samples)
    weights = config.sdf_weight, config.eikonal_weight
    ours = weights[0] * parts.sdf + weights[1] * parts.eikonal

    model = baselines._model(torch_siren, config, network.params)
    tensors = tuple(torch.tensor(np.asarray(array)) for array in (points, samples.sdf, weight))
    theirs = torch_siren.loss(model, *tensors, weights)
    assert abs(theirs.item() - float(ours)) < 1e-4
    value, gradient = torch_siren.value_and_gradient(model, tensors[0])
    expected = siren.predict_with_gradient(config, network.params, points)
    np.testing.assert_allclose(value.detach().numpy(), expected[0], atol=1e-5)
    np.testing.assert_allclose(gradient.numpy(), expected[1], atol=1e-4)

    steps = torch_siren.optimizer(model, config.learning_rate, config.weight_decay)
    torch_siren.train(model, steps, 5, tensors, weights)
    trained, _, _ = training.train(
        config, network, samples, jnp.int32(5), jnp.float32(0), jax.random.key(2)
    )
    after = training.losses(config, trained.params, points, samples)
    ours_after = weights[0] * after.sdf + weights[1] * after.eikonal
    theirs_after = torch_siren.loss(model, *tensors, weights).item()
    assert theirs_after < 0.9 * theirs.item()
    assert theirs_after == pytest.approx(float(ours_after), abs=1e-2)
