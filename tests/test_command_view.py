"""`hiosdf map --view`, `hiosdf view`, and what else there is to do with a saved map."""

import json
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from room_files import BOX, use_room_config, write_range

import hiosdf_jax as hio
from hiosdf_jax._src.command import cli, live_map, map_stream


@pytest.fixture
def saved(room_map, tmp_path):
    hio.save(tmp_path / "map.npz", room_map)
    return tmp_path / "map.npz"


@pytest.fixture
def no_pictures(monkeypatch):
    use_room_config(monkeypatch)

    def draw_map(folder, *_):
        return np.array([0.0, 0, 1])

    monkeypatch.setattr(map_stream.drawing, "draw_map", draw_map)


def test_info_describes_a_map(saved, capsys):
    assert cli.main(["info", str(saved)]) == 0
    text = capsys.readouterr().out
    for part in (
        "a map after 4 updates",
        "extent    x -1.20 to 1.20 m, y -1.00 to 1.00 m, z -0.80 to 0.80 m",
        "24 x 20 x 16 = 7,680 of 0.1 m",
        "problems  none",
        "Config.light, but",
        "max_range = 4.0",
    ):
        assert part in text
    assert re.search(
        r"memory    0\.\d MB as a map, 0\.\d MB as a snapshot, \d\.\d MB as a file", text
    )


def test_info_says_problems_in_plain_words(room_map, tmp_path, capsys):
    flags = np.uint32(hio.Flag.POINTS_OUTSIDE | hio.Flag.INCONSISTENT_CLOUD)
    report = room_map.report.replace(flags=flags)
    hio.save(tmp_path / "map.npz", room_map.replace(report=report))
    assert cli.main(["info", str(tmp_path / "map.npz")]) == 0
    text = capsys.readouterr().out
    assert "POINTS_OUTSIDE: points in range fell outside the bounds" in text
    assert "INCONSISTENT_CLOUD: a cloud contradicted the map" in text


@pytest.mark.parametrize("command", ["info", "view"])
def test_a_file_that_is_no_map_is_one_line(command, tmp_path, capsys):
    assert cli.main([command, str(tmp_path / "none.npz")]) == 2
    (tmp_path / "text.npz").write_text("no map")
    assert cli.main([command, str(tmp_path / "text.npz")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all(line.startswith("hiosdf: ") for line in lines)


def test_the_share_of_drawing_is_bounded():
    now, drawn = [0.0], 0.0
    pace = live_map.Pace(0.1, clock=lambda: now[0])

    def draw():
        now[0] += 0.7

    pace.spend(draw)  # the first one compiles
    start = now[0]
    while now[0] < start + 1000:
        if pace.is_due():
            pace.spend(draw)
            drawn += 0.7
        else:
            now[0] += 0.05
    assert 0.09 * 1000 < drawn <= 0.1 * 1000 + 0.7  # the last one has just ended


def test_without_viser_one_line_says_what_to_install(saved, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    stream = write_range(tmp_path / "room.npz", 3)
    for arguments in (["view", str(saved)], ["map", str(stream), *BOX, "--view"]):
        assert cli.main([*arguments, "--port", "0"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line == "hiosdf: the view needs viser: in a clone, pip install '.[view]'"


def test_wrong_addresses_are_one_line(saved, capsys):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    assert cli.main(["view", str(saved), "--host", "203.0.113.7"]) == 2
    assert cli.main(["view", str(saved), "--port", "70000"]) == 2
    assert cli.main(["view", str(saved), "--export", f"{saved}/none/scene.html"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("hiosdf: host is '203.0.113.7', expected an address of this machine")
    assert lines[1] == "hiosdf: --port is 70000, expected at most 65535"
    assert len(lines) == 3


def test_a_saved_map_becomes_a_page(saved, tmp_path):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    page = tmp_path / "scene.html"
    assert cli.main(["view", str(saved), "--export", str(page)]) == 0
    assert "__VISER_EMBED_DATA__" in page.read_text("utf-8")


def test_ctrl_c_is_the_usual_end_of_a_view(saved):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    command = [sys.executable, "-m", "hiosdf_jax", "view", str(saved), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        assert re.fullmatch(r"the view is at http://127\.0\.0\.1:\d+ until Ctrl-C\n", line)
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, rest) == (0, "")


def test_a_map_is_shown_while_it_grows(tmp_path, no_pictures, monkeypatch, capsys):
    """It can be paused, saved and exported; the run ends as without a view."""
    pytest.importorskip("viser", reason="needs the extra 'view'")
    stream = write_range(tmp_path / "room.npz", 6)
    seen, paused = [], threading.Event()
    whole = live_map.Viewer

    class Watched(whole):
        def show(self, field, cloud=None, pose=None):
            super().show(field, cloud, pose)
            seen.append(int(field.updates))
            if len(seen) == 1:
                self.paused = True
                paused.set()
                threading.Thread(target=self._go_on, daemon=True).start()

        def _go_on(self):
            time.sleep(0.3)
            seen.append(self._on_save())
            self.paused = False

    monkeypatch.setattr(live_map, "Viewer", Watched)
    page, out = tmp_path / "scene.html", tmp_path / "out"
    arguments = ["map", str(stream), *BOX, "--output", str(out), "--export", str(page)]
    assert cli.main(arguments) == 0
    assert paused.is_set()
    assert seen[:2] == [1, str(out / "checkpoint.npz")]  # saved while it was paused
    assert seen[-1] == 6
    assert "__VISER_EMBED_DATA__" in page.read_text("utf-8")
    assert f"wrote {page}" in capsys.readouterr().out


def test_the_plan_has_no_view(capsys):
    assert cli.main(["demo", "--plan", "--view"]) == 2
    assert "--view cannot be combined with --plan" in capsys.readouterr().err


def test_the_vertical_is_an_axis_of_the_world():
    class Tilted:
        def __len__(self):
            return 1

        def __getitem__(self, _):
            pose = np.eye(4)
            pose[:3, :3] = [[1, 0, 0], [0, 0.95, -0.312], [0, 0.312, 0.95]]
            return np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]), pose

    np.testing.assert_array_equal(live_map._up_of_stream(Tilted()), [0, 0, 1])


def test_a_saved_map_becomes_a_file_of_another_program(saved, tmp_path, capsys):
    image, floor = tmp_path / "map.vti", tmp_path / "floor.yaml"
    assert cli.main(["export", str(saved), "--to", str(image), "--resolution", "0.2"]) == 0
    assert image.read_bytes().startswith(b"<?xml")
    robot = ["--floor", "-0.56", "--height", "0.6", "--radius", "0.15"]
    assert cli.main(["export", str(saved), "--to", str(floor), *robot]) == 0
    assert (tmp_path / "floor.pgm").read_bytes().startswith(b"P5\n48 40\n255\n")
    assert capsys.readouterr().out == f"wrote {image}\nwrote {floor}\n"


def test_the_metrics_of_a_run_become_a_table(tmp_path, capsys):
    metrics, table = tmp_path / "metrics.json", tmp_path / "metrics.csv"
    metrics.write_text('{"updates": 3, "scores": {"near_cm": 0.5}}')
    assert cli.main(["export", str(metrics), "--to", str(table)]) == 0
    assert table.read_text() == "name,value\nupdates,3\nscores.near_cm,0.5\n"
    assert capsys.readouterr().out == f"wrote {table}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "map.xyz"], "map.xyz: expected a name with .npz, .vti"),
        (["--to", "floor.pgm"], "a costmap needs --floor, --height and --radius"),
        (["--to", "none/map.vti"], "none: no such folder"),
        (["--to", "{saved}"], "--to {saved} would replace a map"),
        (["--to", "map.vti", "--resolution", "0"], "resolution is 0.0, expected > 0 and finite"),
        (["--to", "map.vti", "--radius", "1"], "--radius is for .pgm and .yaml"),
        (["--to", "metrics.csv"], "{saved}: expected the metrics.json of a run"),
    ],
)
def test_exports_that_cannot_be_are_one_line(arguments, message, saved, monkeypatch, capsys):
    monkeypatch.chdir(saved.parent)
    before = saved.read_bytes()
    arguments = [each.format(saved=saved) for each in arguments]
    assert cli.main(["export", str(saved), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hiosdf: " + message.format(saved=saved))
    assert saved.read_bytes() == before and list(saved.parent.iterdir()) == [saved]


def test_a_run_of_some_frames_says_why_the_surface_has_no_score(tmp_path, no_pictures, capsys):
    stream, out = write_range(tmp_path / "room.npz", 6), tmp_path / "out"
    kept, scores = tmp_path / "map.npz", tmp_path / "scores.json"
    arguments = ["map", str(stream), *BOX, "--output", str(out), "--save", str(kept)]
    for frames, is_scored in (("6", True), ("3", False)):
        assert cli.main([*arguments, "--frames", frames]) == 0
        assert cli.main(["eval", str(kept), str(stream), "--to", str(scores)]) == 0
        for path in (out / "metrics.json", scores):
            written = json.loads(path.read_text())
            assert (written["scores"]["surface_cm"] is not None) == is_scored
            assert ("surface_cm" in written.get("not_scored", {})) == (not is_scored)
        line = "|sdf| on the surface: it is scored once all frames are mapped: "
        assert capsys.readouterr().out.count(line) == (0 if is_scored else 2)


def test_a_saved_map_is_scored_as_its_run_was(tmp_path, no_pictures, capsys):
    stream, out = write_range(tmp_path / "room.npz", 6), tmp_path / "out"
    kept, scores = tmp_path / "map.npz", tmp_path / "scores.json"
    arguments = ["map", str(stream), *BOX, "--output", str(out), "--save", str(kept)]
    assert cli.main(arguments) == 0
    assert cli.main(["eval", str(kept), str(stream), "--to", str(scores)]) == 0
    run = json.loads((out / "metrics.json").read_text())
    again = json.loads(scores.read_text())
    for name, value in again["scores"].items():
        assert value == pytest.approx(run["scores"][name], nan_ok=True), name
    assert again["bands"][">50 cm"]["eikonal"] == run["bands"][">50 cm"]["eikonal"]
    assert "error, visible region" in capsys.readouterr().out


def test_a_stream_without_exact_distances_scores_nothing(saved, tmp_path, capsys):
    stream = write_range(tmp_path / "room.npz", 2, truth=False)
    assert cli.main(["eval", str(saved), str(stream)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("has no exact distances, expected --ground-truth")
