"""Outputs that cannot be written: noticed before the mapping where possible, and nothing lost."""

import errno
import io
import os
import resource
import signal
import subprocess
import sys

import jax
import numpy as np
import pytest
from room_files import BOX, use_room_config, write_points, write_range

import hiosdf_jax as hio
from hiosdf_jax._src.command import cli, map_file, map_stream
from hiosdf_jax._src.datasets import stream as stream_module

RESULTS = ["mesh.ply", "mesh.png", "slices.png", "metrics.json"]


@pytest.fixture
def unmapped(monkeypatch):
    """Fails the test if the mapping begins, or a first reading of the stream."""

    def begin(*_, **__):
        pytest.fail("the work has begun")

    monkeypatch.setattr(map_stream, "run_stream", begin)
    monkeypatch.setattr(cli, "open_inputs", begin)


@pytest.fixture
def quick(monkeypatch):
    """The small map of the other tests, and no pictures."""
    use_room_config(monkeypatch)

    def draw_map(folder, *_):
        for name in RESULTS[:3]:
            (folder / name).write_bytes(b"new")
        return np.array([0.0, 0, 1])

    monkeypatch.setattr(map_stream.drawing, "draw_map", draw_map)


def old_results(folder):
    folder.mkdir(exist_ok=True)
    for name in RESULTS:
        (folder / name).write_bytes(b"old")
    return folder


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def one_line(capsys):
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("hiosdf: ")
    return line.removeprefix("hiosdf: ")


RECORDINGS = {  # what a folder must hold
    "tum": ["depth.txt", "groundtruth.txt"],
    "kitti": ["velodyne"],
    "scannet": ["depth", "pose", "intrinsic"],
    "replicacad": ["traj.txt", "results"],
    "rosbag": ["metadata.yaml"],
}


def case(tmp_path, kind):
    """Arguments that cannot work, and the message that says so."""
    stream = tmp_path / "stream.npz"
    out, map_ = old_results(tmp_path / "out"), ["map", str(stream)]
    if kind == "save into a missing folder":
        return [*map_, "--save", "none/map.npz"], "none: no such folder"
    if kind == "save onto a folder":
        return [*map_, "--save", str(out)], f"{out}: Is a directory"
    if kind == "save onto a read-only file":
        (tmp_path / "map.npz").write_bytes(b"old")
        (tmp_path / "map.npz").chmod(0o444)
        return [
            *map_,
            "--save",
            f"{tmp_path}/map.npz",
        ], f"{tmp_path}/map.npz: the file is read-only"
    if kind == "save onto a device":
        return [*map_, "--save", "/dev/full"], "/dev/full: not a regular file"
    if kind == "save onto the stream":
        return [*map_, "--save", str(stream)], f"--save {stream} would replace {stream}"
    if kind == "save onto a result":
        save = out / "metrics.json"
        arguments = [*map_, "--output", str(out), "--save", str(save)]
        return arguments, f"--save {save} would replace {save}"
    if kind == "save onto a file that is not a map":
        save = tmp_path / "poses.txt"
        save.write_text("0 0 0 0 0 0 0 1")
        return [*map_, "--save", str(save)], f"--save {save} would replace a file that is not a map"
    if kind == "save below a file":
        return [*map_, "--save", f"{stream}/map.npz"], f"{stream}/map.npz: Not a directory"
    if kind == "save onto a long name":
        save = tmp_path / f"{'x' * 256}.npz"
        return [*map_, "--save", str(save)], f"{save}: File name too long"
    if kind == "output into a long name":
        folder = tmp_path / ("x" * 256)
        return [*map_, "--output", str(folder)], f"{folder}: File name too long"
    if kind == "output is a file":
        return [*map_, "--output", str(stream)], f"{stream}: File exists"
    if kind == "output below a file":
        return [*map_, "--output", f"{stream}/out"], f"{stream}: File exists"
    if kind == "a result is read-only":
        (out / "mesh.ply").chmod(0o444)
        return [*map_, "--output", str(out)], f"{out}/mesh.ply: the file is read-only"
    if kind == "a result is a folder":
        (out / "slices.png").unlink()
        (out / "slices.png").mkdir()
        return [*map_, "--output", str(out)], f"{out}/slices.png: Is a directory"
    if kind == "output into a folder of clouds":
        (out / "000001.pcd").write_bytes(b"a cloud")
        return [*map_, "--output", str(out)], f"{out}: holds a recording"
    if kind.startswith("output into a recording of "):
        for name in RECORDINGS[kind.split()[-1]]:
            (out / name).mkdir()
        return [*map_, "--output", str(out)], f"{out}: holds a recording"
    if kind == "output into the stream":
        return ["map", str(out), "--output", str(out)], f"{out}: holds a recording"
    if kind == "a large seed":
        return [*map_, "--seed", str(10**30)], f"--seed is {10**30}, expected at most 4294967295"
    if kind == "a large seed of the demo":
        return ["demo", "--seed", str(2**32)], f"--seed is {2**32}, expected at most 4294967295"
    if kind == "many frames of the demo":
        return ["demo", "--frames", str(10**30)], f"--frames is {10**30}, expected at most 100000"
    if kind == "output of the demo":
        return ["demo", "--output", str(stream)], f"{stream}: File exists"
    assert kind == "output of the plan"
    pytest.importorskip("jax_mppi", reason="needs the extra 'plan'")
    return ["demo", "--plan", "--output", str(stream)], f"{stream}: File exists"


@pytest.mark.parametrize(
    "kind",
    [
        "save into a missing folder",
        "save onto a folder",
        "save onto a read-only file",
        "save onto a device",
        "save onto a long name",
        "output into a long name",
        "save onto the stream",
        "save onto a result",
        "save onto a file that is not a map",
        "save below a file",
        "output is a file",
        "output below a file",
        "a result is read-only",
        "a result is a folder",
        "output into a folder of clouds",
        *(f"output into a recording of {name}" for name in RECORDINGS),
        "output into the stream",
        "a large seed",
        "a large seed of the demo",
        "many frames of the demo",
        "output of the demo",
        "output of the plan",
    ],
)
def test_noticed_before_any_work(tmp_path, capsys, monkeypatch, unmapped, kind):
    monkeypatch.chdir(tmp_path)
    write_range(tmp_path / "stream.npz", 2)
    arguments, message = case(tmp_path, kind)
    before = contents(tmp_path)
    assert cli.main(arguments) == 2
    assert one_line(capsys).startswith(message)
    assert contents(tmp_path) == before


def test_a_folder_without_rights_is_noticed_before_any_work(tmp_path, capsys, unmapped):
    if os.geteuid() == 0:
        folder = "/proc"  # where even root may not write
        reason = "No such file or directory"
    else:
        (tmp_path / "folder").mkdir(mode=0o555)
        folder, reason = str(tmp_path / "folder"), "Permission denied"
    stream = str(write_range(tmp_path / "stream.npz", 2))
    for option in (["--save", f"{folder}/map.npz"], ["--output", f"{folder}/out"]):
        output = [] if "--output" in option else ["--output", str(tmp_path / "out")]
        assert cli.main(["map", stream, *output, *option]) == 2
        assert one_line(capsys) == f"{folder}: {reason}"


def test_truth_that_is_all_later_is_noticed_before_the_mapping(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(map_stream, "run_stream", lambda *_, **__: pytest.fail("mapping"))
    arrays = dict(np.load(write_range(tmp_path / "stream.npz", 6)))
    later = tmp_path / "later.npz"
    np.savez(later, **(arrays | {"eval_visible_frame": np.full(500, 4)}))
    arguments = ["map", str(later), "--output", str(tmp_path / "out"), *BOX, "--frames", "4"]
    assert cli.main(arguments) == 2
    assert one_line(capsys) == (
        "the exact distances begin with frame 4, but the stream has 4 frames"
    )


def test_a_run_that_ends_before_all_truth_is_not_scored(tmp_path, capsys, quick):
    frames, bad = 6, 3
    arrays = dict(np.load(write_points(tmp_path / "scans.npz", frames, bad=[bad])))
    truth = dict(np.load(write_range(tmp_path / "range.npz", frames)))
    truth = {key: value for key, value in truth.items() if key.startswith("eval_")}
    truth["eval_visible_frame"][:] = 5
    np.savez(tmp_path / "scans.npz", **arrays, **truth)
    output = tmp_path / "out"
    assert cli.main(["map", str(tmp_path / "scans.npz"), "--output", str(output), *BOX]) == 2
    text = capsys.readouterr()
    assert "no exact distance belongs to the frames so far" in text.out
    assert text.err.splitlines()[-1].startswith("hiosdf: frame 3: ")
    assert {path.name for path in output.iterdir()} == {*RESULTS, "checkpoint.npz"}


def test_a_full_disk_keeps_the_older_run(tmp_path, capsys, quick, monkeypatch, empty_map):
    stream, saved = write_range(tmp_path / "stream.npz", 3), tmp_path / "map.npz"
    output = old_results(tmp_path / "out")
    hio.save(saved, empty_map)
    older = saved.read_bytes()
    arguments = ["map", str(stream), "--output", str(output), "--save", str(saved), *BOX]
    before = contents(tmp_path)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # The test's stand-in for pictures is small; the map and the report are not.
    # Nor must JAX's cache of compiled functions be written, which other tests read.
    shortest = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, limit[1]))
    try:
        code = cli.main(arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", shortest)
        signal.signal(signal.SIGXFSZ, old)
    assert code == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == f"hiosdf: {output}/metrics.json: {os.strerror(errno.EFBIG)}"
    assert not any("Traceback" in line or "Exception ignored" in line for line in lines)
    assert contents(tmp_path) == before
    # A map that cannot be written is no reason to lose scores and pictures.
    monkeypatch.setattr(map_file, "save_map", refuse)
    assert cli.main(arguments) == 2
    assert one_line_last(capsys) == "hiosdf: map.npz: No space left on device"
    assert saved.read_bytes() == older
    assert (output / "mesh.ply").read_bytes() == b"new"


def refuse(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "map.npz")


def one_line_last(capsys):
    return capsys.readouterr().err.splitlines()[-1]


class Pipe(io.StringIO):
    """Standard output whose reader goes after some lines."""

    def __init__(self, lines):
        super().__init__()
        self.lines = lines

    def write(self, text):
        self.lines -= text.count("\n")
        if self.lines < 0:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
        return super().write(text)


def test_a_reader_that_goes_away_later_loses_nothing(tmp_path, capsys, quick, monkeypatch):
    stream, saved = write_range(tmp_path / "stream.npz", 3), tmp_path / "map.npz"
    output = tmp_path / "out"
    arguments = ["map", str(stream), "--output", str(output), "--save", str(saved), *BOX]
    for lines in (0, 1, 2):
        monkeypatch.setattr(sys, "stdout", Pipe(lines))
        assert cli.main(arguments) == 2
        assert one_line_last(capsys) == "hiosdf: standard output: Broken pipe"
        assert saved.exists() == (lines > 0)  # with no line, it is noticed before the mapping
    assert {path.name for path in output.iterdir()} == set(RESULTS)
    assert int(hio.load(saved).updates) == 3
    # Without a reader of the progress bar the run ends as if nothing had happened.
    monkeypatch.setattr(sys, "stdout", sys.__stdout__)
    monkeypatch.setattr(sys, "stderr", Pipe(0))
    saved.unlink()
    assert cli.main(arguments) == 0
    assert saved.exists()


@pytest.mark.parametrize(
    ("redirection", "message"),
    [
        (">&-", "standard output is closed"),
        (">/dev/full", "standard output: No space left on device"),
        ("| true", "standard output: Broken pipe"),
    ],
)
def test_a_closed_standard_output_is_noticed_before_the_mapping(tmp_path, redirection, message):
    stream = write_range(tmp_path / "stream.npz", 2)
    command = [sys.executable, "-m", "hiosdf_jax", "map", str(stream), *BOX]
    command = " ".join([*command, "--output", str(tmp_path / "out")])
    if redirection == "| true":
        command = f"({command}; echo $? >{tmp_path}/code) {redirection}"
    else:
        command = f"{command} {redirection}; echo $? >{tmp_path}/code"
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60)
    assert result.stderr == f"hiosdf: {message}\n"
    assert (tmp_path / "code").read_text() == "2\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("far", [np.nan, np.inf])
def test_bounds_that_cannot_be_found(tmp_path, capsys, monkeypatch, far):
    extent = stream_module.Extent(((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), far)
    monkeypatch.setattr(stream_module, "find_bounds", lambda *_, **__: extent)
    stream = str(write_range(tmp_path / "stream.npz", 2))
    assert cli.main(["map", stream, "--output", str(tmp_path / "out")]) == 2
    assert one_line(capsys).startswith("the returns are too far to find bounds, expected --bounds")
