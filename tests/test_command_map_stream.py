"""Whole runs of the command on small streams: files, scores, messages and exit codes."""

import json

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from PIL import Image
from room_files import (
    BOX,
    RAYS,
    use_room_config,
    wall_sdf_and_grad,
    write_depth,
    write_points,
    write_range,
)

import hiosdf_jax as hio
from hiosdf_jax._src.command import cli

OUTPUTS = {"metrics.json", "slices.png", "mesh.ply", "mesh.png"}


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text("utf-8"))


def check_pictures(folder, outputs=OUTPUTS):
    assert {path.name for path in folder.iterdir()} == outputs
    for name in ("slices.png", "mesh.png"):
        picture = imread(folder / name)[..., :3]
        assert min(picture.shape[:2]) > 400
        assert picture.std() > 0.05  # it is not empty


def test_a_stream_with_ground_truth(tmp_path, capsys, monkeypatch):
    use_room_config(monkeypatch)
    stream = write_range(tmp_path / "room.npz", 20)
    output = tmp_path / "deep" / "out"
    assert cli.main(["map", str(stream), "--output", str(output), "--seed", "3", *BOX]) == 0
    check_pictures(output)
    metrics = metrics_of(output)
    assert (metrics["stream"], metrics["seed"], metrics["updates"]) == ("room.npz", 3, 20)
    assert metrics["frames_skipped"] == 0
    assert metrics["points_used"] == 20 * RAYS
    assert metrics["flags"] == []
    assert metrics["config"]["max_range"] == 4
    assert hio.Config(**metrics["config"]).bounds == ((-1.2, -1.0, -0.8), (1.2, 1.0, 0.8))
    assert 0 < metrics["update_median_ms"] <= metrics["update_p90_ms"]
    scores = metrics["scores"]
    assert scores["visible_cm"] < 6
    assert scores["within_3m_cm"] == pytest.approx(scores["visible_cm"])  # the room is smaller
    assert set(metrics["bands"]) == {"0-5 cm", "5-20 cm", "20-50 cm", ">50 cm"}
    assert set(metrics["bands"][">50 cm"]) == {"visible_cm", "within_3m_cm", "eikonal", "cosine"}
    vertices = np.asarray(trimesh.load(output / "mesh.ply").vertices)
    assert np.median(np.abs(wall_sdf_and_grad(vertices)[0])) < 0.06
    text = capsys.readouterr()
    assert "error, visible region" in text.out
    assert f"{scores['visible_cm']:.2f}" in text.out
    assert "mapping: 100%" in text.err


def test_a_stream_without_ground_truth_in_a_tilted_world(tmp_path, capsys, monkeypatch):
    use_room_config(monkeypatch)
    monkeypatch.chdir(tmp_path)
    stream = write_depth(tmp_path / "turning.npz", 20)
    saved = tmp_path / "map.npz"
    assert cli.main(["map", str(stream), "--save", str(saved), *BOX]) == 0
    output = tmp_path / "hiosdf_output" / "turning"
    check_pictures(output)
    metrics = metrics_of(output)
    assert metrics["updates"] == 19  # all but frame 15
    assert "scores" not in metrics
    assert metrics["held_out"]["points"] == 24 * 32
    assert metrics["held_out"]["points_observed"] > 600
    assert metrics["held_out"]["median_cm"] < 4
    np.testing.assert_allclose(metrics["up_world"], [0, -1, 0], atol=0.1)
    text = capsys.readouterr()
    assert "held-out returns, median" in text.out
    assert "drawn in a leveled frame" in text.out
    state = hio.load(saved)
    assert int(state.updates) == 19


def test_the_first_bad_frame_ends_the_run(tmp_path, capsys, monkeypatch):
    """The map of the frames before it is written, and the exit code is 2."""
    use_room_config(monkeypatch)
    stream = write_points(tmp_path / "scans.npz", 14, bad=[12])
    output, saved = tmp_path / "out", tmp_path / "map.npz"
    arguments = ["map", str(stream), "--output", str(output), "--save", str(saved)]
    assert cli.main(arguments) == 2  # already while the bounds are found
    message = (
        f"hiosdf: frame 12: {stream}: poses[12]: pose has values that are not finite, "
        "expected a rigid transform: "
    )
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(message)
    assert last.endswith("(--skip-bad-frames skips such frames)")
    assert not output.exists()
    assert cli.main([*arguments, *BOX]) == 2
    text = capsys.readouterr()
    assert text.err.splitlines()[-1] == last
    assert "ended early by frame 12: " in text.out
    check_pictures(output)
    metrics = metrics_of(output)
    assert (metrics["updates"], metrics["frames_skipped"]) == (12, 0)
    assert metrics["stopped_by"].startswith("frame 12: ")
    assert int(hio.load(saved).updates) == 12


def test_the_demo(tmp_path, capsys):
    output = tmp_path / "demo"
    assert cli.main(["demo", "--output", str(output), "--frames", "3", "--config", "light"]) == 0
    check_pictures(output, OUTPUTS | {"growing.gif"})
    with Image.open(output / "growing.gif") as growing:
        assert (growing.n_frames, growing.size) == (3, (640, 480))
    metrics = metrics_of(output)
    assert (metrics["stream"], metrics["updates"]) == ("demo", 3)
    assert set(metrics["scores"]) >= {
        "visible_cm",
        "within_3m_cm",
        "eikonal",
        "cosine",
        "recall",
        "fpr",
        "thin_share",
    }
    assert 0 < metrics["scores"]["thin_share"] < 1
    assert metrics["scores"]["visible_cm"] < 30  # from three frames
    assert "collisions found" in capsys.readouterr().out
    picture = imread(output / "slices.png")
    assert picture.shape[1] > 1.3 * picture.shape[0]  # map, truth and error side by side
