"""The speed benchmark on tiny sizes, and its counts, tables and baselines by hand."""

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
from plain_siren import mean_losses
from room import BOUNDS, CONFIG, room_cloud

import hiosdf_jax as hio
from benchmarks.speed import __main__ as command
from benchmarks.speed import (
    baselines,
    fleets,
    limits,
    meshes,
    plan,
    processes,
    queries,
    rows,
    scaling,
    setup,
    stages,
    updates,
)
from hiosdf_jax import datasets
from hiosdf_jax._src.grid import nearest
from hiosdf_jax._src.grid.windows import Window
from hiosdf_jax._src.network import forward, siren, training
from hiosdf_jax._src.numerics import loops
from hiosdf_jax._src.samples.draw import Samples

# The same map as that of other tests, so that its update is compiled once for them all.
TINY_CONFIG = {
    field.name: getattr(CONFIG, field.name)
    for field in dataclasses.fields(CONFIG)
    if field.name != "bounds"
}
TINY = dataclasses.replace(
    setup.QUICK,
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
command, stream, *config, option, output = sys.argv[1:]
assert (command, config, option) == ("map", ["--config", "light"], "--output")
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


def setup_of(path, frames):
    extent = datasets.Extent(BOUNDS, CONFIG.max_range)
    return setup.Setup(TINY, path, frames, extent, deadline=math.inf)


def test_every_row_has_numbers(stream, tmp_path, monkeypatch, capsys):
    taken_apart = []

    def take_apart(state, frame):
        taken_apart.append((state, frame, stages.take_apart(state, frame)))
        return taken_apart[-1][-1]

    def chosen(setup):  # the others compile updates of their own, and have their own tests
        tasks = plan.make_plan(setup).items()
        return {name: task for name, task in tasks if "sizes" not in name and name != "fleet"}

    def import_time(command, **_):
        return "1.5" if "hiosdf_jax" in command[-1] else "1.0"

    extent = datasets.Extent(BOUNDS, CONFIG.max_range)
    monkeypatch.setattr(command, "QUICK", TINY)
    monkeypatch.setattr(command, "make_plan", chosen)
    monkeypatch.setattr(setup.datasets, "find_bounds", lambda _: extent)
    monkeypatch.setattr(processes.subprocess, "check_output", import_time)
    monkeypatch.setattr(processes, "_HIOSDF", CHECKS_ITS_ARGUMENTS)
    parted = types.SimpleNamespace(take_apart=take_apart, time_parts=stages.time_parts)
    monkeypatch.setattr(plan, "stages", parted)
    output = tmp_path / "out" / "speed.json"
    assert command.main(["--quick", "--stream", str(stream), "--output", str(output)]) == 0
    table = capsys.readouterr().out
    record = json.loads(output.read_text())
    assert {"device", "jax", "revision", "host", "sizes"} <= record.keys()
    found = {row["name"]: row for row in record["rows"]}
    for name, row in found.items():
        assert name in table
        if "median" not in row:
            assert row["note"] == "this device does not report it"
            continue
        spread = [row.get(key, row["median"]) for key in ("p10", "median", "p90", "p99")]
        assert np.isfinite(spread).all() and spread == sorted(spread), row
        assert spread[0] > 0 or name.startswith("compilation"), row
        assert "limit" not in row or row["share"] > 0, row
    assert found["compilations during these"]["median"] == 0
    assert found["update, light, donated"]["compare"] == "not donated"
    assert found["resident memory, peak of hiosdf map"]["median"] > 5
    note = found["6 updates in a row, light, all"]["note"]
    assert note.startswith("flags: none; medians of its tenths: ") and note.count(",") == 5
    limited = ("update_distances, light", "train, light", "the paper's training, 2 epochs of 110")
    for name in (*limited, "sdf and gradient of 300, network, light"):
        assert found[name]["limit"]
    for key in {row["compare"] for row in record["rows"] if "compare" in row}:
        for baseline in record["baselines"][key]:
            assert "median" in baseline or "torch" in baseline["reason"], baseline
    measured = {key for key, beside in record["baselines"].items() if "median" in beside[0]}
    assert measured >= {
        "import",
        "nearest",
        "distance",
        "frontier",
        "endurance",
        "live arrays before",
    }
    ((state, frame, parts),) = taken_apart
    assert {f"{name}, light" for name in parts} <= found.keys()
    made, whole = parts["summarize"].after.state, hio.update(state, *frame)
    pairs = zip(*map(jax.tree.leaves, map(without_key, (made, whole, state))), strict=True)
    for ours, theirs, before in pairs:
        np.testing.assert_allclose(
            np.asarray(ours, float), np.asarray(theirs, float), rtol=1e-3, atol=1e-3
        )
        assert np.shape(before) == np.shape(ours)
    assert int(whole.updates) == int(state.updates) + 1
    assert np.abs(np.asarray(whole.grid.derived.sdf - state.grid.derived.sdf)).max() > 0.01


@pytest.mark.long
def test_a_fleet_is_timed():
    update, query, size, error = fleets.maps_at_once(2, 0.01).rows
    assert update.name == "update of 2 maps of 4 x 4 x 2 m" and update.spread.median > 0
    assert query.spread.median > 0 and size.spread.median > 0.1
    assert error.spread.median < 10


def without_key(state):
    return state.replace(key=jax.random.key_data(state.key))


def test_a_run_that_fails_has_no_peak(monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "_HIOSDF", "raise SystemExit(3)")
    with pytest.raises(RuntimeError, match="exit code 3"):
        processes.run_command(tmp_path)


def test_sizes_of_clouds_and_maps(monkeypatch, tmp_path):
    """An update that does nothing records its arguments, which the rows are about."""
    given = []

    def update(state, cloud, pose, donate=False):
        given.append((state.config, len(cloud), donate))
        return state

    def compilations():
        return {(config.grid_shape, config.max_points, donate) for config, _, donate in given}

    monkeypatch.setattr(hio, "update", update)
    tiny = setup_of(tmp_path, [room_cloud(0)])
    assert scaling.compile_updates(tiny, "light").rows == []
    compiled = compilations()
    given.clear()
    (row,), beside = updates.donated_updates(tiny, "light")
    assert row.name == "update, light, donated" and row.spread.count == TINY.frames
    assert row.compare == "not donated"
    assert beside["not donated"][0].spread.count == TINY.frames
    assert sum(donate for *_, donate in given) == len(given) / 2
    whole = {one for one in compilations() if one[-1]}
    given.clear()
    found, beside = scaling.cloud_sizes(tiny)
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
    (baseline,) = beside["cloud size"]
    assert baseline == rows.Baseline("200 points, 300 used", found[0].spread)
    whole |= compilations()
    given.clear()
    found, beside = scaling.map_sizes(tiny)
    assert [row.note for row in found] == ["20x20x16 voxels", "40x40x16 voxels"]
    assert [row.compare for row in found] == ["", "map size"]
    assert beside["map size"][0].spread == found[0].spread
    assert {config.grid_shape for config, *_ in given} == {(20, 20, 16), (40, 40, 16)}
    assert compiled == whole | compilations()


def test_a_task_makes_what_it_needs_and_shares_it(monkeypatch, tmp_path):
    """Tasks run in any order: maps and rates are made by the first that needs them."""
    made = []

    def map_frames(setup, config, count):
        made.append(config)
        return updates.Mapped(hio.init(config, jax.random.key(0)), [1.0], 0.0)

    def measure(*_):
        made.append("rates")
        return limits.Limits(1.0, 1.0, 1.0), rows.Measured([])

    def asked(label, state, machine, sizes):
        return rows.Measured([rows.Row(label, "ms", rows.single(machine.matrix))])

    monkeypatch.setattr(updates, "map_frames", map_frames)
    monkeypatch.setattr(limits, "measure", measure)
    monkeypatch.setattr(queries, "query_map", asked)
    tasks = plan.make_plan(setup_of(tmp_path, []))
    assert made == []
    for _ in range(2):
        (row,), _ = tasks["queries"]()
        assert row.name == "light" and row.spread.median == 1.0
    assert tasks["limits"]().rows == []
    assert made == [CONFIG, "rates"]


def test_a_row_that_fails_says_why_and_the_rest_continues(stream, tmp_path, monkeypatch, capsys):
    def two_tasks(setup):
        sound = rows.Measured([rows.Row("sound", "ms", rows.single(1.5))])
        return {"broken": lambda: [][0], "sound": lambda: sound}

    monkeypatch.setattr(command, "make_plan", two_tasks)
    arguments = ["--stream", str(stream), "--output", str(tmp_path / "speed.json")]
    assert command.main(arguments) == 1
    table = capsys.readouterr().out
    assert "FAILED" in table and "IndexError: list index out of range" in table
    assert "1.50" in table
    assert command.main([*arguments, "--minutes", "0"]) == 0
    assert "not run" in capsys.readouterr().out
    assert command.main([*arguments, "--only", "oun", "nothing"]) == 0
    record = json.loads((tmp_path / "speed.json").read_text("utf-8"))
    assert record["rows"] == [{"name": "sound", "unit": "ms", "median": 1.5}]
    assert record["took_s"] > 0
    assert record["host"].endswith(f"{os.cpu_count()} cores")
    with pytest.raises(SystemExit):
        command.main([*arguments, "--only", "nothing"])
    assert "'broken', 'sound'" in capsys.readouterr().err


def test_a_record_has_a_row_s_numbers_and_nothing_that_it_lacks():
    spread = rows.Spread(1.23456789, 1.0, 2.0, 3.0, 300)
    row = rows.Row("ours", "ms", spread, "twice", "memory", 0.5)
    assert rows.to_record(row) == {
        "name": "ours",
        "unit": "ms",
        "median": 1.23457,
        "p10": 1.0,
        "p90": 2.0,
        "p99": 3.0,
        "count": 300,
        "compare": "twice",
        "limit": "memory",
        "share": 0.5,
    }
    failed = rows.Row("theirs", note="no gone", failed=True)
    assert rows.to_record(failed) == {"name": "theirs", "note": "no gone", "failed": True}
    zero = rows.Row("compilations", spread=rows.single(0.0))
    assert rows.to_record(zero) == {"name": "compilations", "median": 0.0}
    none = rows.Baseline("gone", None, "no gone")
    assert rows.to_record(none) == {"name": "gone", "reason": "no gone"}


def test_work_is_what_xla_counts():
    config = hio.Config.paper(BOUNDS, eikonal_every=2, epochs=1, near_samples=400, far_samples=100)
    config = dataclasses.replace(config, local_points=10, local_ray_samples=10)
    network = training.init_network(config, jax.random.key(0))
    points = jax.random.uniform(jax.random.key(1), (600, 3))  # XLA would share equal ones
    samples = Samples(points, points[:, 0], jnp.ones(600))

    def operations(function, *arguments):
        return jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]

    def gradient(params):
        def total(params):
            return sum(mean_losses(config, params, points, samples))

        return jax.grad(total)(params)

    # The residuals at the end of an update's training are no part of the gradient.
    once = limits.training_work(config).matrix - limits.network_query_work(config, 600).matrix / 2
    assert once == pytest.approx(operations(gradient, network.params), rel=0.05)
    asked = operations(lambda p: forward.value_and_gradient(10.0, p, points), network.params)
    assert limits.network_query_work(config, 600).matrix == pytest.approx(asked, rel=0.1)


def test_the_distance_transform_s_work_is_what_xla_is_given(monkeypatch):
    # Without a loop, whose work XLA counts once.
    monkeypatch.setattr(loops, "_MOST_PER_STEP", 12)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    window = Window((5, 0, 0), (30, 30, 20), (8, 2, 0), (20, 24, 20))
    part = nearest.Part(window.within, window.inner_shape)
    sites, offset = jnp.zeros((2, *window.shape), bool), jnp.zeros((*window.shape, 3))

    def counted(horizon):  # (0, 2, 1): the short axes of the bounds first
        search = functools.partial(
            nearest.nearest_sites, horizon=horizon, part=part, order=(0, 2, 1)
        )
        return jax.jit(search).lower(sites, offset).cost_analysis()["flops"]

    def work(horizon):
        config = hio.Config.light(((0, 0, 0), (2, 4, 3)), distance_horizon=horizon / 10)
        return limits.distance_work(config, window).vector

    # The difference: the work that does not depend on the horizon is not counted.
    assert work(12) - work(6) == pytest.approx(counted(12) - counted(6), rel=0.02)
    assert work(12) == pytest.approx(2 * work(6))


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
    row = limits.row(machine, "ours", rows.single(4.0), limits.Work(memory=1e6), "twice")
    assert (row.limit, row.compare) == ("memory", "twice") and row.share == pytest.approx(0.25)
    row = limits.row(machine, "ours", rows.single(4.0), None, "")
    assert row.limit == "" and math.isnan(row.share)


def test_pytorch_computes_the_same_loss_and_takes_the_same_steps():
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    from benchmarks.speed import torch_siren

    config = hio.Config.paper(BOUNDS, near_samples=60, far_samples=30, local_points=1)
    config = dataclasses.replace(config, local_ray_samples=10, weight_average=0.0, epochs=5)
    network = training.init_network(config, jax.random.key(0))
    points = jax.random.uniform(jax.random.key(1), (100, 3), minval=-1)
    weight = (jnp.arange(100) % 4 > 0).astype(jnp.float32)
    samples = Samples(points, jnp.linalg.norm(points, axis=-1) - 0.5, weight)
    parts = mean_losses(config, network.params, points, samples)
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
    after = mean_losses(config, trained.params, points, samples)
    ours_after = weights[0] * after.sdf + weights[1] * after.eikonal
    theirs_after = torch_siren.loss(model, *tensors, weights).item()
    assert theirs_after < 0.9 * theirs.item()
    assert theirs_after == pytest.approx(float(ours_after), abs=1e-2)


def test_meshes_are_timed_after_a_call_that_warms_up(monkeypatch, tmp_path):
    asked = []

    def extract_mesh(state, resolution):
        asked.append(resolution)
        return types.SimpleNamespace(faces=[0] * 2000)

    state = types.SimpleNamespace()
    monkeypatch.setattr(meshes, "map_frames", lambda *_: updates.Mapped(state, [1.0], 0.0))
    monkeypatch.setattr(hio, "extract_mesh", extract_mesh)
    found, _ = meshes.extract_meshes(setup_of(tmp_path, []), "light")
    assert [row.name for row in found] == ["mesh of 0.05 m, light", "mesh of 0.025 m, light"]
    assert found[0].spread.count == 3 and found[0].note.startswith("2,000 triangles")
    assert asked == [0.05] * 4 + [0.025] * 4
