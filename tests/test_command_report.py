"""The report of a run: counts and times, the summary, and JSON."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest
from room import CONFIG

import hiosdf_jax as hio
from hiosdf_jax._src.command import report
from hiosdf_jax._src.command.map_frames import Mapped
from hiosdf_jax._src.command.progress import Progress
from hiosdf_jax.datasets import BadFrameError


@pytest.fixture(scope="module")
def mapped():
    """What a run of four updates would leave; the map itself is empty."""
    state = hio.init(CONFIG, jax.random.key(0))
    flags = np.uint32(hio.Flag.POINTS_OUTSIDE | hio.Flag.TRAINING_FAILED)
    return Mapped(
        state=state.replace(report=state.report.replace(flags=flags)),
        path_world=np.zeros((4, 3)),
        up_world=np.array([0.0, 0, 1]),
        update_seconds=np.array([5.0, 0.9, 0.1, 0.3, 0.2]),
        last_frame=5,
        skipped=2,
        stopped=BadFrameError("frame 6: no pose"),
        held_out_world=np.zeros((0, 3)),
        progress=Progress(next_frame=6, points_used=2400, points_outside=4),
    )


def test_times_exclude_the_updates_that_compile_and_warm_up(mapped):
    metrics = report.describe(mapped, CONFIG)
    assert metrics["compile_s"] == 5
    assert metrics["warmup_median_ms"] == pytest.approx(900)
    assert metrics["update_median_ms"] == pytest.approx(200)
    assert metrics["update_p90_ms"] == pytest.approx(280)
    assert metrics["flags"] == ["POINTS_OUTSIDE", "TRAINING_FAILED"]
    assert hio.Config(**metrics["config"]) == CONFIG


def test_a_run_that_continues_a_map_does_not_warm_up_again(mapped):
    later = mapped.state.replace(updates=np.int32(20))
    metrics = report.describe(dataclasses.replace(mapped, state=later), CONFIG)
    assert math.isnan(metrics["warmup_median_ms"])
    assert metrics["update_median_ms"] == pytest.approx(250)
    assert "first 5.0 s (it compiles), then 250 ms (median), " in report.summarize(metrics)


def test_the_summary_names_what_went_wrong(mapped):
    metrics = report.describe(mapped, CONFIG)
    text = report.summarize(metrics)
    expected = "first 5.0 s (it compiles), 900 ms while warming up, then 200 ms (median), 280 ms ("
    assert expected in text
    assert "2 frames could not be used and were skipped" in text
    assert "ended early by frame 6: no pose" in text
    assert "points in range fell outside the bounds and left no surface (4 of 2404)" in text
    assert "flag TRAINING_FAILED: a training step was not finite and was undone" in text
    scored = report.summarize(metrics | {"scores": {"visible_cm": 1.0}, "bands": {}})
    assert "error, visible region" in scored and "true distance" in scored


def test_json_has_null_for_numbers_that_are_not_finite(tmp_path):
    value = {"a": (1, math.nan), "b": {"c": [math.inf, 2.5, "x", None]}}
    report.write_json(tmp_path / "metrics.json", value)
    text = (tmp_path / "metrics.json").read_text("utf-8")
    assert json.loads(text) == {"a": [1, None], "b": {"c": [None, 2.5, "x", None]}}


@pytest.mark.parametrize("flag", hio.Flag, ids=str)
def test_the_summary_has_words_for_every_flag(mapped, flag):
    flags = np.uint32(flag)
    state = mapped.state.replace(report=mapped.state.report.replace(flags=flags))
    metrics = report.describe(dataclasses.replace(mapped, state=state), CONFIG)
    assert f"flag {flag}: " in report.summarize(metrics)
