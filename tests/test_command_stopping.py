"""Runs that are stopped, and runs that continue: the final map is that of a run never stopped."""

import json
import shlex
import signal

import numpy as np
import pytest
from room import arrays_equal
from room_files import BOX, use_room_config, write_depth, write_points, write_range

import hiosdf_jax as hio
from hiosdf_jax._src.command import cli, map_stream, stream_frames
from hiosdf_jax._src.command.progress import load_map
from hiosdf_jax._src.command.stopping import Stopping

FRAMES = 20  # frame 15 is held out
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
_shuffled = np.random.default_rng(0).permutation(FRAMES).tolist()
QUICK, LONG = _shuffled[:4], [pytest.param(i, marks=pytest.mark.long) for i in _shuffled[4:]]
RESULTS = {"metrics.json", "slices.png", "mesh.ply", "mesh.png"}
MEDIANS = {"warmup_median_ms", "update_median_ms", "update_p90_ms"}


@pytest.fixture
def quick(monkeypatch):
    """The small map of the other tests, and no pictures."""
    use_room_config(monkeypatch)

    def draw_map(folder, *_):
        (folder / "mesh.ply").write_bytes(b"a mesh")
        return np.array([0.0, 0, 1])

    monkeypatch.setattr(map_stream.drawing, "draw_map", draw_map)


def interrupt(monkeypatch, frame, how):
    """Calls `how` while a frame is read, for the mapping alone."""
    read = stream_frames.read_frame

    def read_frame(stream, index):
        if index == frame:
            how()
        return read(stream, index)

    monkeypatch.setattr(stream_frames, "read_frame", read_frame)


def metrics_of(folder):
    """What does not depend on times, or on how the run was started."""
    metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
    volatile = {"compile_s", "total_s", "stopped_by", *MEDIANS}
    return {name: value for name, value in metrics.items() if name not in volatile}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A stream, and the final map and metrics of a run that was never stopped."""
    folder = tmp_path_factory.mktemp("recording")
    stream = write_depth(folder / "turning.npz", FRAMES)
    with pytest.MonkeyPatch.context() as patch:
        use_room_config(patch)
        patch.setattr(map_stream.drawing, "draw_map", lambda *_: np.array([0.0, 0, 1]))
        arguments = ["map", str(stream), "--output", str(folder / "out"), *BOX]
        assert cli.main([*arguments, "--save", str(folder / "map.npz")]) == 0
    return stream, load_map(folder / "map.npz"), metrics_of(folder / "out")


def check_equal(path, recording):
    """The saved map is that of the run never stopped, with all that it says of itself."""
    saved, expected = load_map(path), recording[1]
    assert saved[1:] == expected[1:]
    assert arrays_equal(saved.state, expected.state)


@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("frame", [*QUICK, *LONG])
def test_a_stopped_run_continues(tmp_path, capsys, monkeypatch, quick, recording, number, frame):
    output, saved = tmp_path / "out", tmp_path / "map.npz"
    arguments = ["map", str(recording[0]), "--output", str(output), "--save", str(saved), *BOX]
    with monkeypatch.context() as patch:
        interrupt(patch, frame, lambda: signal.raise_signal(number))
        assert cli.main(arguments) == CODES[number]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    reason = f"{number.name} after {frame + 1} of {FRAMES} frames"
    if frame < FRAMES - 1:
        text = capsys.readouterr().out
        assert f"ended early by {reason}" in text
        again = text.split(f"stopped by {reason}; to resume:\n")[1].strip()
        assert load_map(saved).progress.next_frame == frame + 1
        assert json.loads((output / "metrics.json").read_text())["stopped_by"] == reason
        assert (output / "mesh.ply").exists()
        assert cli.main(shlex.split(again)[1:]) == 0
    check_equal(saved, recording)
    assert metrics_of(output) == recording[2]
    assert {path.name for path in output.iterdir()} == {"metrics.json", "mesh.ply"}


def test_a_run_that_is_stopped_twice_without_a_file_of_its_own(
    tmp_path, capsys, monkeypatch, recording
):
    """With all pictures; the map waits in the folder until the run has finished."""
    use_room_config(monkeypatch)
    output = tmp_path / "out"
    first = ["map", "--output", str(output), *BOX, "--frames", "12", "--", str(recording[0])]
    arguments = first
    for frame in (3, 8):
        with monkeypatch.context() as patch:
            interrupt(patch, frame, lambda: signal.raise_signal(signal.SIGTERM))
            assert cli.main(arguments) == 143
        again = shlex.split(capsys.readouterr().out.splitlines()[-1])
        assert again.count("--resume") == 1
        assert {path.name for path in output.iterdir()} == RESULTS | {"checkpoint.npz"}
        assert int(hio.load(output / "checkpoint.npz").updates) == frame + 1
        arguments = again[1:]
    assert cli.main(arguments) == 0
    assert {path.name for path in output.iterdir()} == RESULTS
    with monkeypatch.context() as patch:
        interrupt(patch, 9, lambda: signal.raise_signal(signal.SIGINT))
        assert cli.main(first) == 130
    # The configuration is that of the map, without a first reading; the stream may have grown.
    capsys.readouterr()
    longer = ["map", str(recording[0]), "--output", str(output), "--save", str(tmp_path / "map")]
    assert cli.main([*longer, "--resume", str(output / "checkpoint.npz")]) == 0
    check_equal(tmp_path / "map", recording)
    assert "finding bounds" not in capsys.readouterr().err
    assert {path.name for path in output.iterdir()} == RESULTS


def test_a_second_signal_ends_the_process_at_once():
    before = signal.getsignal(signal.SIGTERM)
    with Stopping() as stopping:
        stopping.in_order()
        signal.raise_signal(signal.SIGTERM)
        assert stopping.received == signal.SIGTERM
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_signal_that_the_process_ignores_stays_ignored(monkeypatch):
    old = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Stopping() as stopping:
            signal.raise_signal(signal.SIGINT)
        assert stopping.received is None
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, old)


@pytest.mark.parametrize("number", CODES)
def test_a_signal_before_the_mapping(tmp_path, capsys, monkeypatch, quick, recording, number):
    from hiosdf_jax._src.datasets import stream as stream_module

    read, output = stream_module.read_frame, tmp_path / "out"

    def read_frame(stream, index):
        signal.raise_signal(number)
        return read(stream, index)

    arguments = ["map", str(recording[0]), "--output", str(output)]
    with monkeypatch.context() as patch:
        patch.setattr(stream_module, "read_frame", read_frame)
        assert cli.main(arguments) == CODES[number]
    assert capsys.readouterr().err.splitlines()[-1] == "hiosdf: stopped; nothing was written"
    assert not output.exists()
    # While frames that the map knows are read once more, too.
    saved = tmp_path / "map.npz"
    with monkeypatch.context() as patch:
        interrupt(patch, 5, lambda: signal.raise_signal(number))
        assert cli.main([*arguments, *BOX, "--save", str(saved)]) == CODES[number]
    before = saved.read_bytes(), (output / "metrics.json").read_bytes()
    with monkeypatch.context() as patch:
        interrupt(patch, 2, lambda: signal.raise_signal(number))
        again = [*arguments, "--save", str(saved), "--resume", str(saved)]
        assert cli.main(again) == CODES[number]
    assert (saved.read_bytes(), (output / "metrics.json").read_bytes()) == before


def test_a_crashed_run_continues_from_its_last_checkpoint(tmp_path, monkeypatch, quick, recording):
    output = tmp_path / "out"
    output.mkdir()
    (output / "metrics.json").write_text("of an older run")
    arguments = ["map", str(recording[0]), "--output", str(output), *BOX]

    def crash():
        raise RuntimeError("a crash")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="a crash"):
        interrupt(patch, 17, crash)
        cli.main([*arguments, "--checkpoint-every", "4"])
    assert load_map(output / "checkpoint.npz").progress.next_frame == 17  # 16 updates
    assert (output / "metrics.json").read_text() == "of an older run"
    saved = tmp_path / "map.npz"
    again = ["--save", str(saved), "--resume", str(output / "checkpoint.npz")]
    assert cli.main([*arguments, *again]) == 0
    check_equal(saved, recording)
    assert metrics_of(output) == recording[2]


def test_a_map_of_another_run_is_kept_aside(tmp_path, monkeypatch, quick, recording, capsys):
    output, saved = tmp_path / "out", tmp_path / "map.npz"
    arguments = ["map", str(recording[0]), "--output", str(output), *BOX]

    def stopped_after(frames, *options):
        with monkeypatch.context() as patch:
            interrupt(patch, frames - 1, lambda: signal.raise_signal(signal.SIGINT))
            assert cli.main([*arguments, *options]) == 130

    def frames_of(path):
        return load_map(path).progress.next_frame

    stopped_after(9)
    stopped_after(2)
    text = f"{(output / 'checkpoint.npz').resolve()} is of another run: kept as checkpoint.1.npz"
    assert text in capsys.readouterr().out
    assert frames_of(output / "checkpoint.1.npz") == 9
    stopped_after(4, "--resume", str(output / "checkpoint.npz"))
    assert frames_of(output / "checkpoint.npz") == 4
    assert not (output / "checkpoint.2.npz").exists()
    # A run that continues another file leaves this one; only its end replaces --save.
    resume = ["--resume", str(output / "checkpoint.1.npz"), "--save", str(saved)]
    saved.write_bytes((output / "checkpoint.npz").read_bytes())
    stopped_after(12, *resume)
    assert frames_of(tmp_path / "map.1.npz") == 4 and frames_of(saved) == 12
    assert cli.main([*arguments, *resume]) == 0
    check_equal(saved, recording)
    assert not (tmp_path / "map.2.npz").exists()
    assert frames_of(output / "checkpoint.npz") == 4


def test_a_run_continues_after_a_bad_frame(tmp_path, monkeypatch, quick, capsys):
    stream = write_points(tmp_path / "scans.npz", 8, bad=[5])
    arguments = ["map", str(stream), "--output", str(tmp_path / "out"), *BOX]
    whole, part = tmp_path / "whole.npz", tmp_path / "part.npz"
    assert cli.main([*arguments, "--save", str(whole), "--skip-bad-frames"]) == 0
    assert cli.main([*arguments, "--save", str(part)]) == 2
    again = [*arguments, "--save", str(part), "--resume", str(part)]
    assert cli.main([*again, "--skip-bad-frames"]) == 0
    assert load_map(part)[1:] == load_map(whole)[1:]
    assert arrays_equal(load_map(part).state, load_map(whole).state)
    capsys.readouterr()
    assert cli.main(again) == 2  # the map has skipped a frame that this run may not skip
    assert capsys.readouterr().err.splitlines()[-1].startswith("hiosdf: frame 5: ")


def test_a_map_of_something_else_is_refused(tmp_path, monkeypatch, quick, recording, capsys):
    stream, saved = str(recording[0]), tmp_path / "map.npz"
    map_ = ["map", stream, "--output", str(tmp_path / "out")]
    with monkeypatch.context() as patch:
        interrupt(patch, 5, lambda: signal.raise_signal(signal.SIGINT))
        assert cli.main([*map_, *BOX, "--seed", "3", "--save", str(saved)]) == 130
    before = saved.read_bytes(), (tmp_path / "out" / "metrics.json").read_bytes()
    hio.save(tmp_path / "plain.npz", hio.load(saved))
    with np.load(saved) as file:
        arrays = dict(file)
    header = json.loads(str(arrays.pop("header")))
    for name, progress in (
        ("list", [1]),
        ("less", {"next_frame": 6}),
        ("type", header["progress"] | {"next_frame": 6.0}),
        ("negative", header["progress"] | {"next_frame": -6}),
    ):
        text = np.asarray(json.dumps(header | {"progress": progress}))
        np.savez(tmp_path / f"{name}.npz", header=text, **arrays)
    other = str(write_depth(tmp_path / "other.npz", 3))
    with_truth = str(write_range(tmp_path / "truth.npz", FRAMES))
    raw = dict(np.load(stream))
    raw["depth"][4, 0, 0] += 1  # by a millimeter
    np.savez(tmp_path / "changed.npz", **raw)
    unknown = "the file does not say how far the map has come in its stream"
    cases = [
        (map_, ["--seed", "4"], f"--seed is 4, expected 3 as in {saved}"),
        (map_, ["--max-range", "3.9"], f"--max-range is 3.9, expected 4.0 as in {saved}"),
        (map_, ["--voxel-size", "0.2"], f"--voxel-size is 0.2, expected 0.1 as in {saved}"),
        (map_, ["--bounds", *"000111"], "--bounds is [0.0, 0.0, 0.0, 1.0, 1.0, 1.0], expected [-"),
        (map_, ["--config", "paper"], f"--config is paper, not that of {saved}"),
        (["map", other], [], f"{saved}: the map was made from 6 frames, but the stream has only 3"),
        (
            ["map", str(tmp_path / "changed.npz")],
            [],
            f"{saved}: the map was made from other frames than the first 6 of this stream",
        ),
        (["map", with_truth], [], f"{saved} was mapped without exact distances"),
        (map_, ["--resume", str(tmp_path / "none.npz")], f"{tmp_path}/none.npz: No such file"),
        (map_, ["--resume", stream], f"{stream}: not a readable hiosdf_jax map"),
        *(
            (map_, ["--resume", str(tmp_path / f"{name}.npz")], f"{tmp_path}/{name}.npz: {unknown}")
            for name in ("plain", "list", "less", "type", "negative")
        ),
    ]
    for command, options, message in cases:
        resume = [] if "--resume" in options else ["--resume", str(saved)]
        output = ["--output", str(tmp_path / "out")]
        assert cli.main([*command, *output, *resume, *options]) == 2
        text = capsys.readouterr().err
        assert text.splitlines()[-1].startswith(f"hiosdf: {message}"), text
        assert "Traceback" not in text
    assert (saved.read_bytes(), (tmp_path / "out" / "metrics.json").read_bytes()) == before
