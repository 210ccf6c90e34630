"""The gate of refined poses and tracked streams, and how their errors are measured."""

from argparse import Namespace

import numpy as np
import pytest

from benchmarks import pose_record, records
from benchmarks.registration import error, perturb
from benchmarks.tracking import DRIFT, GLITCH, JITTER, change, measure_poses

GOOD = {"5 cm, 3 degrees": {"median_cm": 0.2, "p95_cm": 0.8, "far": 1, "most_cm": 13.0}}


def worse_by(**figures):
    rows = {"5 cm, 3 degrees": GOOD["5 cm, 3 degrees"] | figures}
    return pose_record.compare(GOOD, rows)


def test_the_gate_finds_what_is_worse_and_passes_the_rest():
    assert worse_by() == ([], 3)  # the largest error is one pose's: it is not compared
    assert worse_by(median_cm=0.25, p95_cm=0.96, far=2, most_cm=50.0) == ([], 3)
    assert worse_by(median_cm=0.01, p95_cm=0.1, far=0) == ([], 3)
    assert worse_by(median_cm=0.3)[0] == ["5 cm, 3 degrees: median_cm 0.2 -> 0.3"]
    assert worse_by(p95_cm=np.nan)[0] == ["5 cm, 3 degrees: p95_cm 0.8 -> nan"]
    assert len(worse_by(far=3, p95_cm=1.1)[0]) == 2


def test_rows_that_vary_by_half_are_not_compared():
    old = {"jitter, seed 0": {"map_cm": 0.7}, "jitter smoothed, seed 0": {"map_cm": 0.6}}
    new = {"jitter, seed 0": {"map_cm": 1.7}, "jitter smoothed, seed 0": {"map_cm": 0.9}}
    worse, compared = pose_record.compare(old, new)
    assert worse == ["jitter smoothed, seed 0: map_cm 0.6 -> 0.9"] and compared == 1
    none, one = {"glitch": {"fused_wrong": 0}}, {"glitch": {"fused_wrong": 1}}
    assert pose_record.compare(none, one)[0] == ["glitch: fused_wrong 0 -> 1"]


def test_counts_that_should_be_high_are_compared_from_below():
    old = {"its own map": {"sure": 68, "recall": 0.99}}
    assert pose_record.compare(old, {"its own map": {"sure": 60, "recall": 0.986}})[0] == []
    assert len(pose_record.compare(old, {"its own map": {"sure": 30, "recall": 0.5}})[0]) == 2


def test_rows_are_kept_and_compared_by_the_options(tmp_path, monkeypatch, capsys):
    path = tmp_path / "record.json"
    monkeypatch.setattr(pose_record, "RECORD", path)
    options = Namespace(output=path, gate=False)
    assert pose_record.finish(options, "refining", "room", GOOD) == 0
    assert pose_record.finish(options, "refining", "room", {"exact": {"p95_cm": 0.123456}}) == 0
    kept = records.read(path)["refining"]["room"]
    measured = GOOD | {"exact": {"p95_cm": 0.1235}}
    assert kept == {row: figures | records.provenance() for row, figures in measured.items()}
    gate = Namespace(output=None, gate=True)
    assert pose_record.finish(gate, "refining", "room", GOOD) == 0
    assert pose_record.finish(gate, "refining", "room", {"exact": {"p95_cm": 1.0}}) == 1
    assert "1 figures compared, 1 worse" in capsys.readouterr().out
    assert pose_record.finish(gate, "refining", "elsewhere", GOOD) == 1  # nothing to compare with
    both = Namespace(output=path, gate=True)  # the gate reads the record before it is written
    assert pose_record.finish(both, "refining", "room", {"exact": {"p95_cm": 1.0}}) == 1


@pytest.fixture
def path_of_a_robot():
    """Poses (70, 4, 4) along a straight line of 6.9 m, from a robot that turns."""
    eyes = [perturb(np.eye(4), np.random.default_rng(i), 0.0, 50.0) for i in range(70)]
    for i, pose in enumerate(eyes):
        pose[0, 3] = 0.1 * i
    return eyes


def test_poses_are_made_worse_as_documented(path_of_a_robot):
    exact = path_of_a_robot

    def away(mode):
        errors = [error(a, b) for a, b in zip(change(exact, mode), exact, strict=True)]
        return np.linalg.norm(np.array(errors).reshape(-1, 2, 3), axis=2)

    np.testing.assert_allclose(away("exact"), 0, atol=1e-7)
    np.testing.assert_allclose(away("none"), 0, atol=1e-7)
    jitter = away("jitter smoothed")
    np.testing.assert_allclose(jitter[1:, 0], JITTER[0], rtol=1e-3)
    np.testing.assert_allclose(np.degrees(jitter[1:, 1]), JITTER[1], rtol=1e-3)
    glitch = away("glitch")[:, 0]
    np.testing.assert_allclose(glitch[list(GLITCH)], 1.0, rtol=1e-5)
    assert np.count_nonzero(glitch) == len(GLITCH)
    end_m, end_rad = away("drift known")[-1]
    np.testing.assert_allclose(np.degrees(end_rad), DRIFT[1] * 6.9, rtol=0.05)
    # 1 % of the way ahead, and to the side the sum of what each turn adds.
    aside_m = np.radians(DRIFT[1]) * 6.9**2 / 2
    np.testing.assert_allclose(end_m, np.hypot(DRIFT[0] * 6.9, aside_m), rtol=0.05)


def test_errors_of_poses_are_those_of_their_positions(path_of_a_robot):
    exact = path_of_a_robot
    moved = [pose.copy() for pose in exact]
    moved[-1][:3, 3] += [0.0, 0.03, 0.04]
    found = measure_poses(moved, [(None, pose) for pose in exact])
    np.testing.assert_allclose(found["end_cm"], 5.0, rtol=1e-4)
    np.testing.assert_allclose(found["most_cm"], 5.0, rtol=1e-4)
    np.testing.assert_allclose(found["rms_cm"], 5.0 / np.sqrt(70), rtol=1e-4)
    assert found["end_deg"] < 0.05  # float32
