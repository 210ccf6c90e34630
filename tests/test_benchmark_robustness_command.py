"""The robustness benchmark: its faults, its bars, its gate and its command."""

from types import SimpleNamespace

import numpy as np
import pytest
from room_files import write_range

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.robustness import __main__ as command
from benchmarks.robustness import faults, figures, gate, library, scenes
from benchmarks.robustness.library import Frame, Played, Setup
from benchmarks.robustness.sensors import depth_camera
from benchmarks.robustness.worlds import World
from hiosdf_jax import datasets


@pytest.fixture
def stream():
    setup = Setup("light", 0)
    scans = scenes.scan_all(
        setup, depth_camera(20, 15), lambda _: World(scenes.ROOM), range(40), scenes.touring_path
    )
    frames = scenes.frames_of(scans)
    return faults.Stream("room", scenes.BOUNDS, 9.0, frames, np.zeros((1, 3)), np.zeros(1))


def test_bursts_are_functions_of_their_seed(stream):
    for label, burst in faults.BURSTS.items():
        first, again = (burst(stream, np.random.default_rng(0)) for _ in range(2))
        assert len(first) in (1, 5, 10, 30), label
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a.cloud, b.cloud)
            np.testing.assert_array_equal(a.pose, b.pose)
            assert np.isfinite(a.cloud).all(axis=1).any()
    covered = faults.BURSTS["lens covered for 5 frames"](stream, np.random.default_rng(0))[0]
    assert np.nanmax(np.abs(covered.cloud[:, 2] - 0.12)) < 0.02
    off = faults.BURSTS["5 frames 1 m off"](stream, np.random.default_rng(0))[0]
    assert np.linalg.norm(off.pose[:3, 3] - stream.frames[25].pose[:3, 3]) == pytest.approx(1)


def test_steady_faults_do_what_they_say(stream):
    frame = stream.frames[1]
    spoiled = {
        label: spoil(frame, 1, np.random.default_rng(0))
        for label, (spoil, _) in faults.STEADY.items()
    }
    lost = np.isnan(spoiled["30 % drop-outs"].cloud[:, 0]).mean()
    assert 0.2 < lost < 0.4
    wrong = np.abs(spoiled["5 % outliers"].cloud - frame.cloud).max(axis=1) > 1e-3
    assert 0.01 < wrong.mean() < 0.1
    ranges = np.linalg.norm(frame.cloud, axis=1)
    off = np.linalg.norm(spoiled["5 cm noise"].cloud, axis=1) - ranges
    assert np.nanstd(off) == pytest.approx(0.05, rel=0.2)
    turned = spoiled["poses 2 cm and 1 degree off"].pose
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-9)
    assert 0 < np.linalg.norm(turned[:3, 3] - frame.pose[:3, 3]) < 0.1
    every_other = faults.STEADY["5 cm noise every other frame"][0]
    assert every_other(frame, 0, np.random.default_rng(0)) is frame


def test_a_house_is_read_with_the_truth_of_its_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(faults, "_HOUSE_FRAMES", 3)
    path = write_range(tmp_path / "house_depth.npz", 5)
    house = faults.open_stream(Setup("light", 0), tmp_path)
    assert house.name == "house" and len(house.frames) == 3
    truth, recorded = datasets.read_truth(path), np.load(path)
    first = recorded["eval_visible_frame"] < 3
    assert 0 < len(house.points) == np.count_nonzero(first) < len(truth.sdf)
    np.testing.assert_array_equal(house.truth, truth.sdf[first])
    for k, frame in enumerate(house.frames):
        ranges = np.linalg.norm(frame.cloud, axis=1)
        np.testing.assert_allclose(np.sort(ranges), np.sort(recorded["range"][k]), rtol=1e-5)
        np.testing.assert_allclose(frame.pose, recorded["poses"][k], rtol=1e-6, atol=1e-7)


def test_alarms_of_the_clean_stream_are_none():
    clean = faults.Clean(None, None, int(hio.Flag.POINTS_OUTSIDE))
    outside, bad = int(hio.Flag.POINTS_OUTSIDE), int(hio.Flag.BAD_POSE)
    played = Played(None, [outside, bad, 0, 0], [None, None, "a message", None])
    assert faults._alarm(clean, played) == {"flagged": 0.5}
    assert faults._alarm(clean, played, 1) == {"flagged": 0}


def test_a_map_is_played_and_its_flags_are_those_of_each_update(monkeypatch):
    given = []

    def update(state, cloud, pose, **extras):
        given.append(extras)
        if pose is None:
            raise ValueError("no pose")
        flags = state.report.flags | np.uint32(2 if len(cloud) == 0 else 0)
        return _State(flags)

    class _State(SimpleNamespace):
        def __init__(self, flags):
            report = SimpleNamespace(flags=np.uint32(flags))
            report.replace = lambda flags: SimpleNamespace(flags=flags)
            super().__init__(report=report)

        def replace(self, report):
            return _State(report.flags)

    monkeypatch.setattr(hio, "update", update)
    monkeypatch.setattr(library, "_ACCEPTED", frozenset({"noise"}))
    some = np.zeros((2, 3))
    frames = [
        Frame(some[:0], np.eye(4)),
        Frame(some, np.eye(4), noise=(0.05, 0.0), robot=(some, some[:, 0])),
        Frame(some, None),
    ]
    played = library.play(_State(0), frames, "test")
    assert played.flags == [2, 0, 0]
    assert played.refused == [None, None, "no pose"]
    assert given == [{}, {"noise": (0.05, 0.0)}, {}]


def test_bars_are_checked_for_each_row():
    results = {
        "appears after 1, camera": {
            "solid": [1.0, 0.99],
            "solid_lower": [0.5],
            "pushed_out": [1.0],
            "side_cm": [0.5],
            "coverage": [0.995],
            "slack_cm": [7.0],
        },
        "walks, lidar": {"side_cm": [1.0]},
    }
    checks = {(each.row, each.bar.figure): each.met for each in figures.check(results)}
    assert checks["appears after 1, camera", "solid"]
    assert not checks["appears after 1, camera", "solid_lower"]
    assert not checks["appears after 1, camera", "slack_cm"]
    assert not checks["walks, lidar", "row_recall"]  # not measured is not met
    assert ("walks, lidar", "coverage") not in checks
    table = figures.format_tables({"some": results})
    assert "0.5!" in table and "7!" in table


def test_every_bar_is_about_a_known_figure():
    assert {bar.figure for bar in figures.BARS} <= set(figures.FIGURES)


def test_the_gate_finds_what_got_worse(tmp_path):
    old = {"row": {"solid": [0.99], "side_cm": [1.0], "bias_cm": [-0.5], "error_ratio": [2.0]}}
    same = gate.compare(old, old)
    assert same == gate.Verdict([], [], 4)
    new = {"row": {"solid": [0.9], "side_cm": [0.5], "bias_cm": [0.6]}, "other": {"solid": [0.0]}}
    verdict = gate.compare(old, new)
    assert len(verdict.worse) == 2  # solid, and error_ratio is missing
    assert verdict.better == ["row: side_cm 1 -> 0.5"]
    path = tmp_path / "baseline.json"
    record = {"device": "cpu", "jax": "0", "revision": "abc1234", "seeds": [0], "rows": old}
    gate.update_baseline(path, "light", record)
    gate.update_baseline(path, "light", record | {"rows": {"more": {"solid": [1.0]}}})
    gate.update_baseline(path, "default", record)
    loaded = records.read(path)
    assert loaded["light"]["rows"] == old | {"more": {"solid": [1.0]}}
    assert loaded["light"]["revision"] == "abc1234"
    assert set(loaded) == {"light", "default"}
    part = record | {"revision": "def5678", "rows": {"row": {"solid": [0.9, 1.0]}}}
    gate.update_means(path, "light", part)
    loaded = records.read(path)["light"]
    assert loaded["revision"] == "abc1234, def5678" and loaded["jax"] == "0"
    assert loaded["rows"] == {"row": {"solid": 0.95}, "more": {"solid": [1.0]}}


def test_a_baseline_without_a_number_is_worse_than_any(tmp_path):
    path = tmp_path / "baseline.json"
    gate.update_baseline(path, "light", {"rows": {"row": {"solid": [np.nan]}}})
    rows = records.read(path)["light"]["rows"]
    assert gate.compare(rows, {"row": {"solid": [1.0]}}).worse == ["row: solid nan -> 1"]


def test_the_command_runs_a_scenario_and_compares(tmp_path, monkeypatch, capsys):
    rows = {"appears after 1, camera": {"solid": 0.2, "side_cm": 1.0}}
    monkeypatch.setattr(command, "scenarios", lambda data: {"appear": lambda setup: rows})
    baseline, output = tmp_path / "baseline.json", tmp_path / "run.json"
    arguments = ["--baseline", str(baseline), "--output", str(output), "--seeds", "0", "1"]
    monkeypatch.setattr(command, "_TABLES", tmp_path / "tables.json")
    assert command.main([*arguments, "--update-baseline", "--update-tables"]) == 0
    for path in (output, baseline, tmp_path / "tables.json"):
        assert records.provenance().items() <= records.read(path)["light"].items()
    assert records.read(output)["light"]["rows"] == {
        "appears after 1, camera": {"solid": [0.2, 0.2], "side_cm": [1.0, 1.0]}
    }
    assert command.main(arguments) == 0
    assert command.main([*arguments, "--bars"]) == 1
    assert "MISSED appears after 1, camera: solid 0.2" in capsys.readouterr().out
    rows["appears after 1, camera"]["solid"] = 0.1
    assert command.main(arguments) == 1
    assert "WORSE" in capsys.readouterr().out
