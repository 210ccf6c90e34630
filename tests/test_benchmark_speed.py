"""The speed benchmark on tiny sizes: every row has numbers, and its parts are what they say."""

import dataclasses
import functools
import json
import math
import os
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, CONFIG, room_cloud

import hiosdf_jax as hio
from benchmarks.speed import __main__ as command
from benchmarks.speed import baselines, limits, rows, stages, tasks
from hiosdf_jax import datasets
from hiosdf_jax._src.grid import carving, distance, evidence, frontier
from hiosdf_jax._src.grid.change import Window
from hiosdf_jax._src.grid.rays import place_cloud
from hiosdf_jax._src.network import forward, siren, training
from hiosdf_jax._src.samples.draw import Samples

# The same map as that of other tests, so that its update is compiled once for them all.
TINY_CONFIG = {
    field.name: getattr(CONFIG, field.name)
    for field in dataclasses.fields(CONFIG)
    if field.name != "bounds"
}
TINY = dataclasses.replace(
    tasks.QUICK,
    overrides=TINY_CONFIG,
    paper_overrides={"near_samples": 60, "far_samples": 30, "local_points": 1, "epochs": 2},
    frames=3,
    seconds=0.01,
    processes=1,
    matrix_edge=64,
    elements=1 << 14,
    queries=300,
    baked_queries=500,
    cloud_sizes=(200, 500),
    map_edges=(2.0, 4.0),
    endurance=6,
)


# Stands for the command that maps a whole stream, which takes too long for a test.
CHECKS_ITS_ARGUMENTS = """
import sys, pathlib
command, stream, option, output = sys.argv[1:]
assert (command, option) == ("map", "--output")
assert pathlib.Path(stream).is_file() and pathlib.Path(output).is_dir()
"""


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
    taken_apart = []

    def take_apart(state, cloud, pose):
        taken_apart.append((state, cloud, pose, stages.take_apart(state, cloud, pose)))
        return taken_apart[-1][-1]

    def plan(bench):
        return [(name, task) for name, task in tasks.plan(bench) if "sizes" not in name]

    def import_time(command, **_):
        return "1.5" if "hiosdf_jax" in command[-1] else "1.0"

    extent = datasets.Extent(BOUNDS, CONFIG.max_range)
    monkeypatch.setattr(command, "QUICK", TINY)
    monkeypatch.setattr(command, "plan", plan)
    monkeypatch.setattr(tasks.datasets, "find_bounds", lambda _: extent)
    monkeypatch.setattr(tasks.subprocess, "check_output", import_time)
    monkeypatch.setattr(tasks, "_HIOSDF", CHECKS_ITS_ARGUMENTS)
    monkeypatch.setattr(tasks, "stages", types.SimpleNamespace(take_apart=take_apart))
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
        assert spread[0] > 0 or name.startswith("compilation"), row
        assert not row["limit"] or row["share"] > 0, row
    assert found["compilations during these"]["spread"]["median"] == 0
    assert found["resident memory, peak of hiosdf map"]["spread"]["median"] > 5
    note = found["6 updates in a row, light, all"]["note"]
    assert note.startswith("flags: none; medians of its tenths: ") and note.count(",") == 5
    for name in taken_apart[0][-1]:
        assert found[f"{name}, light"]["limit"]
    for key in {row["compare"] for row in record["rows"]} - {""}:
        for baseline in record["baselines"][key]:
            assert baseline["spread"] or "torch" in baseline["reason"], baseline
    measured = {key for key, beside in record["baselines"].items() if beside[0]["spread"]}
    assert measured >= {
        "import",
        "nearest",
        "distance",
        "frontier",
        "endurance",
        "live arrays before",
    }

    assert found["update, light, donated"]["compare"] == "not donated"
    ((state, cloud, pose, parts),) = taken_apart
    assert_stages_make_the_update(parts, state, hio.update(state, cloud, pose))


def assert_stages_make_the_update(parts, state, whole):
    network, _, _ = parts["training"].result
    for ours, theirs, before in (
        (parts["frontier"].result, whole.grid, state.grid),
        (parts["calibration"].result, whole.optimism, None),
        (network, whole.network, state.network),
    ):
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(
                np.asarray(a, float), np.asarray(b, float), rtol=1e-3, atol=1e-3
            )
        if before is not None:
            pairs = zip(jax.tree.leaves(theirs), jax.tree.leaves(before), strict=True)
            assert max(np.abs(np.asarray(a, float) - np.asarray(b)).max() for a, b in pairs) > 0.01


def test_a_run_that_fails_has_no_peak(monkeypatch, tmp_path):
    extent = datasets.Extent(BOUNDS, CONFIG.max_range)
    bench = tasks.Bench(TINY, tmp_path, [], extent, deadline=math.inf)
    monkeypatch.setattr(tasks, "_HIOSDF", "raise SystemExit(3)")
    with pytest.raises(RuntimeError, match="exit code 3"):
        tasks.whole_run_rows(bench)


def test_sizes_of_clouds_and_maps(monkeypatch, tmp_path):
    """With an update that does nothing: what it is given is what the rows are about."""
    given = []

    def update(state, cloud, pose, donate=False):
        given.append((state.config, len(cloud), donate))
        return state

    def compilations():
        return {(config.grid_shape, config.max_points, donate) for config, _, donate in given}

    monkeypatch.setattr(tasks.hio, "update", update)
    extent = datasets.Extent(BOUNDS, CONFIG.max_range)
    bench = tasks.Bench(TINY, tmp_path, [room_cloud(0)], extent, deadline=math.inf)
    assert tasks.compile_sizes(bench) == []
    compiled = compilations()
    given.clear()
    (row,) = tasks.donated_rows(bench)
    assert row.name == "update, light, donated" and row.spread.count == TINY.frames
    assert bench.baselines["not donated"][0].spread.count == TINY.frames
    assert sum(donate for *_, donate in given) == len(given) / 2
    whole = {one for one in compilations() if one[-1]}
    given.clear()
    found = tasks.cloud_size_rows(bench)
    assert [row.name for row in found] == [
        "update, light, 200 points, 300 used",
        "update, light, 200 points, all used",
        "update, light, 500 points, 300 used",
        "update, light, 500 points, all used",
    ]
    assert {(config.max_points, count) for config, count, _ in given} == {
        (300, 200),
        (200, 200),
        (300, 500),
        (500, 500),
    }
    assert [row.compare for row in found] == ["", *["cloud size"] * 3]
    (baseline,) = bench.baselines["cloud size"]
    assert baseline == rows.Baseline("200 points, 300 used", found[0].spread)
    whole |= compilations()
    given.clear()
    found = tasks.map_size_rows(bench)
    assert [row.note for row in found] == ["20x20x16 voxels", "40x40x16 voxels"]
    assert [row.compare for row in found] == ["", "map size"]
    assert bench.baselines["map size"][0].spread == found[0].spread
    assert {config.grid_shape for config, *_ in given} == {(20, 20, 16), (40, 40, 16)}
    assert compiled == whole | compilations()


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
    assert command.main([*arguments, "--only", "oun", "nothing"]) == 0
    record = json.loads((tmp_path / "speed.json").read_text("utf-8"))
    assert [row["name"] for row in record["rows"]] == ["sound"]
    assert record["took_s"] > 0
    assert record["host"].endswith(f"{os.cpu_count()} cores")
    with pytest.raises(SystemExit):
        command.main([*arguments, "--only", "nothing"])
    assert "'broken', 'sound'" in capsys.readouterr().err


def test_work_is_what_xla_counts():
    config = hio.Config.paper(BOUNDS, eikonal_every=2, epochs=1, near_samples=400, far_samples=100)
    config = dataclasses.replace(config, local_points=10, local_ray_samples=10)
    network = training.init_network(config, jax.random.key(0))
    points = jax.random.uniform(jax.random.key(1), (600, 3))  # not equal ones: XLA would share
    samples = Samples(points, points[:, 0], jnp.ones(600))

    def operations(function, *arguments):
        return jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]

    def gradient(params):
        def loss(params):
            return sum(training.losses(config, params, points, samples))

        return jax.grad(loss)(params)

    # The residuals at the end of an update's training are no part of the gradient.
    once = limits.training_work(config).matrix - limits.network_query_work(config, 600).matrix / 2
    assert once == pytest.approx(operations(gradient, network.params), rel=0.05)
    asked = operations(lambda p: forward.value_and_gradient(10.0, p, points), network.params)
    assert limits.network_query_work(config, 600).matrix == pytest.approx(asked, rel=0.1)


def test_the_distance_transform_s_work_is_what_xla_is_given():
    window = Window((5, 0, 0), (30, 30, 20), (8, 2, 0), (20, 24, 20))
    part = distance.Part(window.within, window.inner_shape)
    sites, offset = jnp.zeros(window.shape, bool), jnp.zeros((*window.shape, 3))

    def counted(horizon):  # (0, 2, 1): the short axes of the bounds first
        search = functools.partial(
            distance.nearest_sites, horizon=horizon, part=part, order=(0, 2, 1)
        )
        return jax.jit(search).lower(sites, offset).cost_analysis()["flops"]

    def work(horizon):
        config = hio.Config.light(((0, 0, 0), (2, 4, 3)), distance_horizon=horizon / 10)
        return limits.distance_work(config, window).vector

    # The difference: what is done once, however far a pass looks, is not counted.
    assert work(12) - work(6) == pytest.approx(2 * (counted(12) - counted(6)), rel=0.02)
    assert work(12) == pytest.approx(2 * work(6))


def test_the_frontier_s_work_is_what_xla_is_given():
    window = Window((5, 0, 0), (30, 30, 10), (8, 2, 0), (20, 24, 10))
    seen = jnp.zeros(window.shape, bool)

    def counted(reach):
        search = functools.partial(frontier.signed_box_distance, reach=reach)
        return jax.jit(search).lower(seen).cost_analysis()["flops"]

    def work(reach):
        config = hio.Config.light(((0, 0, 0), (4, 4, 1)), frontier_horizon=reach / 10)
        assert config.frontier_voxels == reach
        return limits.frontier_work(config, window).vector

    # Beyond 9 voxels the shortest axis has no more to compare.
    assert work(12) - work(6) == pytest.approx(counted(12) - counted(6), rel=0.05)
    assert work(6) == pytest.approx(counted(6), rel=0.2)


def test_the_evidence_s_work_is_the_size_of_its_arrays():
    state = hio.init(CONFIG, jax.random.key(0))
    start, window = evidence.read_evidence(CONFIG, state.grid, jnp.zeros(3))
    stored = evidence.write_evidence(state.grid, start, window)
    assert window.hits.shape == CONFIG.grid_shape  # so that both have as many voxels

    def size(grid, *names):
        arrays = grid.__dict__ | grid.surface.__dict__
        return sum(arrays[name].nbytes for name in names)

    fused, traced = ("hits", "weight", "mean", "axes"), ("passes", "behind")
    every = {*fused, *traced}
    work = limits.evidence_work(window.hits.size, 300, 50.0)
    assert work["window"].memory == size(state.grid, *every) + size(window, *every)
    assert work["fading"].memory == size(window, *every) + size(stored, *every)
    assert work["fusion"].memory == 2 * size(window, *fused) + 300 * (12 + 1)
    beams = place_cloud(CONFIG, jnp.ones((300, 3)), jnp.ones(300, bool), jnp.eye(4))
    needed = (beams.directions_world, beams.free_ranges, beams.in_range, beams.ends)
    read = sum(array.nbytes for array in needed)
    assert work["rays"].memory == 2 * size(window, *traced) + read

    def a_voxel(*names):
        return size(state.grid, *names) / state.grid.evidence.hits.size

    # One of nearest's three numbers, two of the three axes; a sample is written with its weight.
    whole = size(state.grid, *traced, "hits", "sdf", "nearest") - 2 * state.grid.evidence.hits.size
    asked = 8 * a_voxel("nearest", "sdf") + a_voxel("mean") + 2 / 3 * a_voxel("axes") + 5 * 4
    samples = CONFIG.near_samples + CONFIG.far_samples
    drawn = limits.grid_samples_work(CONFIG)
    assert drawn.memory == pytest.approx(whole + asked * samples)
    asked = 8 * a_voxel("nearest", "sdf", "doubt", "frontier") + a_voxel("mean", "axes") + 3 * 4
    network = limits._network_work(CONFIG, 50, 1).memory
    assert limits.calibration_work(CONFIG, 300, 50).memory == network + 300 + 50 * asked


def test_steps_are_those_of_the_rays():
    """They are counted by the grid that they are added to: two rays that end, one that does not."""
    cloud = jnp.asarray([[0.55, 0, 0], [0, 0.45, 0], [0, 0, 5.0]])
    config = dataclasses.replace(CONFIG, max_range=0.6)
    beams = place_cloud(config, cloud, jnp.ones(3, bool), jnp.eye(4))
    assert beams.ends.tolist() == [True, True, False]
    start, window = evidence.read_evidence(config, evidence.empty_grid(config), beams.sensor_world)
    traced = carving.trace_rays(config, window, start, beams)
    counted = float(traced.passes.sum() + traced.behind.sum())
    assert abs(tasks._steps(config, beams) - counted) < 1


def test_a_row_stands_beside_its_baselines():
    beside = {
        "twice": [rows.Baseline("slow", rows.single(8.0)), rows.Baseline("gone", None, "no gone")]
    }
    row = rows.Row("ours", "ms", rows.single(2.0), "twice", "memory", 0.5, "short")
    _, _, ours, reason, note = rows.format_table([row], beside).splitlines()
    assert ours.split()[-3:] == ["slow", "8.00", "0.250"]
    assert ours.split()[:7] == ["ours", "[1]", "ms", "2.00", "memory", "50.0", "%"]
    assert reason.split() == ["gone:", "no", "gone", "none"]
    assert note == "[1] short"


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
    config = dataclasses.replace(config, local_ray_samples=10, weight_average=0.0, epochs=5)
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
        config, network, samples, jnp.int32(0), jnp.float32(0), jax.random.key(2)
    )
    after = training.losses(config, trained.params, points, samples)
    ours_after = weights[0] * after.sdf + weights[1] * after.eikonal
    theirs_after = torch_siren.loss(model, *tensors, weights).item()
    assert theirs_after < 0.9 * theirs.item()
    assert theirs_after == pytest.approx(float(ours_after), abs=1e-2)
