"""The frames of a stream: fused, skipped, held out, and the one that ends the mapping."""

import json

import jax
import numpy as np
import pytest
from room import CONFIG, room_cloud
from room_files import BOX, RAYS, use_room_config, write_points

from hiosdf_jax._src.command import cli, map_stream, report
from hiosdf_jax._src.command.map_frames import fuse_frames
from hiosdf_jax._src.command.progress import Progress
from hiosdf_jax._src.command.stream_frames import StreamFrames
from hiosdf_jax.datasets import NpzStream


def test_bad_frames_are_skipped_and_points_outside_left_out(tmp_path, capsys, monkeypatch):
    use_room_config(monkeypatch)
    monkeypatch.setattr(map_stream.drawing, "draw_map", lambda *_: np.array([0.0, 0, 1]))
    stream = write_points(tmp_path / "scans.npz", 8, empty=[2], bad=[4], stray=[0, 0, 2.5])
    arguments = ["map", str(stream), "--output", str(tmp_path / "out"), "--frames", "6"]
    assert cli.main([*arguments, *BOX, "--skip-bad-frames"]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text("utf-8"))
    assert (metrics["updates"], metrics["frames_skipped"]) == (4, 2)
    assert metrics["flags"] == ["POINTS_OUTSIDE"]
    assert (metrics["points_used"], metrics["points_outside"]) == (4 * RAYS, 4)
    assert "held_out" not in metrics  # the stream is too short
    text = capsys.readouterr()
    assert "frame 2: cloud has no finite row" in text.err
    assert f"frame 4: {stream}: poses[4]: pose has values that are not finite" in text.err
    assert "2 frames could not be used" in text.out
    assert f"left no surface (4 of {4 * RAYS + 4})" in text.out


def test_bad_frames_among_those_held_out(tmp_path):
    stream = NpzStream(write_points(tmp_path / "scans.npz", 4, bad=[2]))
    key = jax.random.key(0)
    mapped = fuse_frames(stream, CONFIG, key, held_out=[1, 2], skip_bad_frames=True)
    assert (int(mapped.state.updates), mapped.skipped, mapped.last_frame) == (2, 1, 3)
    cloud, pose = stream[1]
    assert mapped.held_out_world.shape == (RAYS, 3)  # without the stray return, which is too near
    expected = cloud[:RAYS] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(np.sort(mapped.held_out_world, 0), np.sort(expected, 0), atol=1e-6)
    mapped = fuse_frames(stream, CONFIG, key, held_out=[1, 2])
    assert (int(mapped.state.updates), mapped.last_frame) == (1, 0)
    assert str(mapped.stopped).startswith("frame 2: ")


def test_the_bar_ends_with_the_frames_that_were_read(tmp_path):
    stream = NpzStream(write_points(tmp_path / "scans.npz", 8))
    asked = iter([*[None] * 5, "SIGINT"])
    frames = StreamFrames(stream, Progress(), skip_bad_frames=False, stop=lambda: next(asked))
    with frames.bar:
        while frames.read_next():
            pass
    assert str(frames.stopped) == "SIGINT after 5 of 8 frames"
    assert (frames.next_frame, frames.bar.n) == (5, 5)


def test_no_usable_frame(tmp_path, capsys, monkeypatch):
    use_room_config(monkeypatch)
    stream = write_points(tmp_path / "scans.npz", 2, bad=[0, 1])
    arguments = ["map", str(stream), "--output", str(tmp_path / "out")]
    assert cli.main([*arguments, *BOX]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("hiosdf: frame 0: ")
    arguments.append("--skip-bad-frames")
    assert cli.main([*arguments, *BOX]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == "hiosdf: none of the 2 frames could be mapped, expected at least one"
    assert cli.main(arguments) == 1  # bounds cannot be found either
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "hiosdf: none of the 2 frames can be used, expected at least one"


def test_a_refused_frame_adds_no_points():
    near, pose = room_cloud(0)
    with pytest.warns(UserWarning, match="cloud has 0 of 250 returns between"):
        mapped = fuse_frames(
            [(near, pose), (near + 30, pose), (near, pose)], CONFIG, jax.random.key(0)
        )
    assert int(mapped.state.updates) == 2
    assert (mapped.progress.points_used, mapped.progress.points_outside) == (500, 0)
    assert "flag OUT_OF_RANGE" in report.summarize(report.describe(mapped, CONFIG))
