"""`hiosdf bench`: what it measures, its table, and its file. Its times are not tested."""

import json

import jax
import pytest
from room import CONFIG, stream

from hiosdf_jax._src.command import bench, cli


@pytest.fixture(scope="module")
def record():
    return bench.measure(stream(4), CONFIG, queries=64, resolution=0.2, seconds=0.0)


def test_every_figure_is_measured(record, room_map):
    rows = {row["name"]: row for row in record["rows"]}
    assert [(name, row["unit"]) for name, row in rows.items()] == [
        ("first update", "s"),
        ("updates per second", "1/s"),
        ("an update", "ms"),
        ("64 distances with gradient", "ms"),
        ("bake at 20 cm", "ms"),
        ("64 distances with gradient, baked", "ms"),
        ("arrays of the map", "MB"),
    ]
    assert all(row["value"] > 0 for row in rows.values())
    assert all(row["p10"] <= row["value"] <= row["p90"] for row in rows.values() if "p10" in row)
    update = rows["an update"]["value"]
    assert rows["updates per second"]["value"] == pytest.approx(1000 / update)
    size = 1e-6 * sum(leaf.nbytes for leaf in jax.tree.leaves(room_map))
    assert rows["arrays of the map"]["value"] == pytest.approx(size)
    assert (record["updates"], record["voxels"]) == (4, list(CONFIG.grid_shape))
    assert (record["device"], record["jax"]) == (jax.devices()[0].device_kind, jax.__version__)


def test_the_table_has_units_and_the_device(record):
    text = bench.format_record(record)
    head, _, first, *_ = text.splitlines()
    assert head.split() == ["unit", "value", "10", "%", "below", "90", "%", "below"]
    assert first.split()[:3] == ["first", "update", "s"]
    assert f"device {record['device']}, host {record['host']}, jax {jax.__version__}" in text
    assert "24 x 20 x 16 voxels" in text
    for cached, words in ((True, "or reads JAX's compilation cache"), (False, "later runs read")):
        assert words in bench.format_record(record | {"compilation_cache": cached})


def test_the_command_prints_and_writes(record, tmp_path, monkeypatch, capsys):
    given = {}

    def measure(frames, config):
        given.update(frames=len(frames), config=config)
        return record

    monkeypatch.setattr(bench, "measure", measure)
    file = tmp_path / "bench.json"
    assert cli.main(["bench", "--config", "paper", "--json", str(file)]) == 0
    assert (given["frames"], given["config"].hidden_width) == (bench.FRAMES, 256)
    assert json.loads(file.read_text("utf-8")) == json.loads(json.dumps(record))
    printed = capsys.readouterr().out
    assert bench.format_record(record) in printed and f"wrote {file}" in printed


def test_a_file_that_cannot_be_written_is_named_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "measure", lambda *_: pytest.fail("the work has begun"))
    assert cli.main(["bench", "--json", str(tmp_path / "none" / "bench.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hiosdf: ") and "no such folder" in line
