"""Metrics as CSV, read back by the csv module."""

import csv
import json

import pytest

from hiosdf_jax import scoring

METRICS = {
    "updates": 3,
    "stopped_by": None,
    "scores": {"visible_cm": 0.1 + 0.2, "recall": 1e-17},
    "bands": {"0-5 cm": {"visible_cm": 0.5}},
    "config": {"bounds": [[0.0, 0, 0], [1, 2.5, 3]]},
    "stream": 'a "house", with commas\nand lines',
    "flags": [],
}


def test_every_value_comes_back(tmp_path):
    scoring.write_csv(tmp_path / "metrics.csv", json.loads(json.dumps(METRICS)))
    with open(tmp_path / "metrics.csv", newline="", encoding="utf-8") as file:
        rows = {row["name"]: row["value"] for row in csv.DictReader(file)}
    assert rows["updates"] == "3" and rows["stopped_by"] == ""
    assert float(rows["scores.visible_cm"]) == 0.1 + 0.2
    assert float(rows["scores.recall"]) == 1e-17
    assert rows["bands.0-5 cm.visible_cm"] == "0.5"
    assert float(rows["config.bounds.1.1"]) == 2.5
    assert rows["stream"] == METRICS["stream"]
    assert len(rows) == 5 + 6 + 1 and "flags" not in rows


def test_something_else_is_refused(tmp_path):
    with pytest.raises(ValueError, match="metrics is list, expected a dict"):
        scoring.write_csv(tmp_path / "metrics.csv", [])
    assert not list(tmp_path.iterdir())
