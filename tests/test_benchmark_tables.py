"""Committed records, and the tables of the documents, which must be those of the records."""

import json
import math
import re

import pytest

from benchmarks import records
from benchmarks.accuracy import results
from benchmarks.tables import __main__ as command
from benchmarks.tables import accuracy, markdown, registration, robustness, speed

RECORDS = sorted(records.RESULTS.glob("*.json"))


def test_tables_in_the_documents_are_those_of_the_records():
    for path in command.documents():
        text = path.read_text("utf-8")
        assert markdown.render(text, command.TABLES) == text, (
            f"{path} differs from the records: python -m benchmarks.tables rewrites it"
        )


@pytest.mark.parametrize("name", ["README.md", "benchmarks/README.md"])
def test_measured_figures_stand_in_marked_tables_only(name):
    rest = markdown.MARKED.sub("", (records.ROOT / name).read_text("utf-8"))
    assert "\n<!-- table" not in rest and "\n<!-- /table" not in rest
    rows = [line for line in rest.splitlines() if line.startswith("|")]
    assert not [row for row in rows if re.search(r"\d\.\d", re.sub("`.*?`", "", row))]


def test_check_finds_what_differs_and_the_command_repairs_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(records, "ROOT", tmp_path)
    document = tmp_path / "README.md"
    document.write_text("Before.\n<!-- table: real -->\n| 1.0 |\n<!-- /table -->\nAfter.\n")
    assert command.main(["--check"]) == 1
    assert "README.md: differs" in capsys.readouterr().out
    assert "| 1.0 |" in document.read_text()
    assert command.main([]) == 0
    expected = f"Before.\n<!-- table: real -->\n{accuracy.real()}<!-- /table -->\nAfter.\n"
    assert document.read_text() == expected
    assert command.main(["--check"]) == 0
    document.write_text("<!-- table: nothing -->\n<!-- /table -->")
    with pytest.raises(KeyError, match="nothing"):
        command.main([])


def test_cells_are_the_records_figures():
    house = accuracy.house().splitlines()
    assert house[2] == "| Voxfield, 10 cm | 3.09 | 0.927 / 0.019 | 6.39 | |"
    record = json.loads((records.RESULTS / "accuracy.json").read_text())
    mean = record["house_lidar"]["default"]["mean"]["network"]
    cells = next(line for line in house if "its network alone" in line).split(" | ")
    assert cells[3:] == [
        f"{mean['visible_cm']:.2f}",
        f"{mean['recall']:.3f} / {mean['fpr']:.3f} |",
    ]
    record = json.loads((records.RESULTS / "registration.json").read_text())
    row = record["refining"]["house_lidar, light, all frames"]["15 cm, 6 degrees"]
    cells = registration.refining().splitlines()[2 + 8].split(" | ")
    assert cells[:3] == ["| house_lidar", "`light`", "15 cm and 6 degrees off"]
    assert cells[5] == f"{row['p95_cm']:.2f} cm, {row['p95_deg']:.3f}°"
    error = record["merging"]["house_depth"]["one pass"]["visible_cm"]
    assert registration.merging().splitlines()[2].split(" | ")[1] == f"{error:.2f}"
    row = record["wrong poses"]["kitchen_depth"]["0.5 m off"]
    line = next(line for line in registration.wrong_poses().splitlines() if "kitchen" in line)
    assert line.split(" | ")[-1] == f"{row['taken']:.0f} |"
    row = record["places"]["hall_lidar"]["89 in its own map"]
    assert registration.places().splitlines()[-1].split(" | ")[2:4] == [
        f"{row['found']:.0f}",
        f"{row['sure']:.0f}",
    ]
    record = json.loads((records.RESULTS / "speed_gpu.json").read_text())
    times = {row["name"]: row for row in record["rows"]}
    torch = record["baselines"]["training"][-1]
    assert "TF32" in torch["name"]
    training = times["the paper's training, 10 epochs of 60,000"]
    line = next(line for line in speed.gpu().splitlines() if "60,000 samples" in line)
    numbers = [training["median"], training["p99"], None, torch["median"]]
    assert line.split("|")[2:-1] == [f" {x:.1f} " if x else " " for x in numbers]


@pytest.mark.parametrize("name", command.TABLES)
def test_every_table_has_cells_in_every_row(name):
    head, rule, *rows = command.TABLES[name]().splitlines()
    assert rows and set(rule) <= set("|- ")
    for row in rows:
        assert row.count("|") == head.count("|")
        assert re.search(r"\d", row.split("|", 2)[2]), row


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_records_say_what_they_are_measured_on(path):
    found = list(_leaves(records.read(path), frozenset()))
    assert found
    for keys, value in found:
        assert {"device", "jax", "revision"} <= keys, value


def _leaves(value, keys):
    """Numbers of a record, with the keys that are beside them or above."""
    if isinstance(value, dict):
        for item in value.values():
            yield from _leaves(item, keys | value.keys())
    elif isinstance(value, list):
        for item in value:
            yield from _leaves(item, keys)
    elif isinstance(value, float):
        yield keys, value


def test_tables_of_robustness_name_every_bar_that_is_missed():
    record = json.loads((records.RESULTS / "robustness.json").read_text())["default"]["rows"]
    bars, missed = robustness.bars().splitlines(), robustness.missed().splitlines()
    met, all_bars = map(int, bars[2].split(" | ")[-1].strip(" |").split(" of "))
    assert 0 < met < all_bars
    late = [line for line in missed if line.startswith("| appears after 1, lidar | `slack_cm`")]
    assert late and f"{record['appears after 1, lidar']['slack_cm']:.3g} | at most 6 |" in late[0]
    assert len(missed) - 2 >= all_bars - met  # those of Config.light may be others


def test_records_are_small():
    assert sum(len(path.read_text().splitlines()) for path in RECORDS) <= 3000


def test_short_innermost_parts_of_a_record_stand_side_by_side(tmp_path):
    value = {"a": [1, 2.5], "b": {"c": {"d": math.nan, "e": "x"}, "f": True}, "g": [[0], {}]}
    value |= {"h": "y" * 60, "i": "z" * 60, "j": 0}
    path = tmp_path / "new" / "record.json"
    records.write(path, value)
    assert path.read_text().splitlines() == [
        "{",
        ' "a": [1, 2.5],',
        ' "b": {',
        '  "c": {"d": null, "e": "x"}, "f": true',
        " },",
        ' "g": [',
        "  [0], {}",
        " ],",
        f' "h": "{"y" * 60}",',
        f' "i": "{"z" * 60}", "j": 0',
        "}",
    ]
    value["b"]["c"]["d"] = None
    assert records.read(path) == value
    assert records.read(tmp_path / "none.json") == {}
    assert records.rounded(1.23456789) == 1.23457 and records.rounded(1234567.8) == 1234570


def test_provenance_is_that_of_this_process(tmp_path, monkeypatch):
    found = records.provenance()
    assert found.keys() == {"device", "jax", "revision"} and all(found.values())
    monkeypatch.setattr(records, "ROOT", tmp_path)
    assert records.provenance()["revision"] == "unknown"


def test_updating_the_tables_keeps_other_entries(tmp_path):
    def runs(*values):
        scores = [{"visible_cm": value, "bias_cm": 0.1} for value in values]
        head = {"frames": 20, "device": "cpu", "jax": "0", "revision": "abc1234"}
        return [
            head | {"seed": seed, "variants": {"grid": {"scores": one, "bands": {}}}}
            for seed, one in enumerate(scores)
        ]

    path = tmp_path / "accuracy.json"
    results.update_tables(path, {("room", "light"): runs(1.0, 2.0)})
    results.update_tables(path, {("room", "light, epochs=2"): runs(3.0)})
    record = records.read(path)["room"]
    assert record["light"] == {
        "frames": 20,
        "device": "cpu",
        "jax": "0",
        "revision": "abc1234",
        "seeds": [0, 1],
        "mean": {"grid": {"visible_cm": 1.5}},
        "half_range": {"grid": {"visible_cm": 0.5}},
    }
    assert record["light, epochs=2"]["mean"] == {"grid": {"visible_cm": 3.0}}
