"""Processes that are killed or signaled from outside, at any moment."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from room import arrays_equal
from room_files import BOX, write_depth

import hiosdf_jax as hio
from hiosdf_jax._src.command.progress import load_map

HERE = Path(__file__).parent
FRAMES = 20
RESULTS = {"metrics.json", "slices.png", "mesh.ply", "mesh.png"}

SAVING = """
import sys
import jax.numpy as jnp
import hiosdf_jax as hio
state = hio.load(sys.argv[1])
first = int(state.updates)
for k in range(first + 1, first + 10_000):
    hio.save(sys.argv[1], state.replace(updates=jnp.int32(k)))
    print(k, flush=True)
"""


@pytest.mark.parametrize("kills", [2, pytest.param(100, marks=pytest.mark.long)])
def test_kills_during_saves(room_map, tmp_path, kills):
    """The file always loads, and holds every save that has returned."""
    path, rng, during = tmp_path / "map.npz", np.random.default_rng(0), 0
    hio.save(path, room_map)
    for _ in range(kills):
        arguments = [sys.executable, "-c", SAVING, str(path)]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
            done = int(process.stdout.readline())
            try:
                process.wait(rng.uniform(0, 0.2))
            except subprocess.TimeoutExpired:
                process.kill()
            done = int(([done, *process.stdout.read().split("\n")[:-1]])[-1])
        assert process.returncode == -signal.SIGKILL
        parts = [each.name for each in tmp_path.iterdir() if each.name.endswith(".part")]
        assert len(parts) <= 1
        during += len(parts)
        state = hio.load(path)
        assert done <= int(state.updates) <= done + 1
        assert arrays_equal(state.replace(updates=room_map.updates), room_map)
    print(f"{during} of {kills} kills hit a save before its end")
    assert kills < 10 or during > kills / 2
    hio.save(path, room_map)
    assert [each.name for each in tmp_path.iterdir()] == ["map.npz"]


# The command with the tests' small map; it says which frame it reads.
COMMAND = """
import signal, sys
sys.path.insert(0, sys.argv.pop(1))
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
import pytest
from room_files import use_room_config
from hiosdf_jax._src.command import cli, stream_frames
use_room_config(pytest.MonkeyPatch())
read = stream_frames.read_frame
def read_frame(stream, index):
    print("frame", index, flush=True)
    return read(stream, index)
stream_frames.read_frame = read_frame
sys.exit(cli.main(sys.argv[1:]))
"""


def start(arguments):
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, str(HERE), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(HERE.parent)},
    )


def wait_for(process, text):
    for line in process.stdout:
        if line == text + "\n":
            return
    pytest.fail(f"no line {text!r}: {process.stderr.read()}")


@pytest.mark.long
def test_signals_from_outside(tmp_path):
    """Folder and map are complete each time; the resumed run's map is that of one never stopped."""
    stream = write_depth(tmp_path / "turning.npz", FRAMES)
    map_ = ["map", str(stream), *BOX]
    whole, saved = tmp_path / "whole.npz", tmp_path / "map.npz"
    process = start([*map_, "--output", str(tmp_path / "whole"), "--save", str(whole)])
    assert process.communicate()[1] and process.returncode == 0
    expected = load_map(whole)
    frames = np.random.default_rng(1).integers(0, FRAMES, FRAMES)
    for frame, number in zip(frames, 10 * [signal.SIGINT, signal.SIGTERM], strict=True):
        output = tmp_path / f"{frame}_{number}"
        arguments = [*map_, "--output", str(output), "--save", str(saved)]
        process = start(arguments)
        wait_for(process, f"frame {frame}")
        process.send_signal(number)
        text, errors = process.communicate()
        assert process.returncode == 128 + number, errors
        assert {path.name for path in output.iterdir()} == RESULTS
        metrics = json.loads((output / "metrics.json").read_text())
        stopped = load_map(saved)
        assert int(stopped.state.updates) == metrics["updates"]
        assert frame < stopped.progress.next_frame <= FRAMES
        if metrics["stopped_by"] is not None:
            assert "--resume" in text.splitlines()[-1]
        process = start([*arguments, "--resume", str(saved)])
        assert process.communicate()[1] and process.returncode == 0
        resumed = load_map(saved)
        assert resumed[1:] == expected[1:]
        assert arrays_equal(resumed.state, expected.state)


def test_a_second_signal_ends_the_process_and_keeps_the_older_run(tmp_path):
    stream, output = write_depth(tmp_path / "turning.npz", FRAMES), tmp_path / "out"
    output.mkdir()
    for name in RESULTS:
        (output / name).write_text("of an older run")
    process = start(["map", str(stream), *BOX, "--output", str(output)])
    wait_for(process, "frame 3")
    process.send_signal(signal.SIGTERM)
    wait_for(process, "drawing slices.png, mesh.ply and mesh.png")  # the first one is being obeyed
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == -signal.SIGTERM
    assert {(output / name).read_text() for name in RESULTS} == {"of an older run"}
    assert 4 <= int(hio.load(output / "checkpoint.npz").updates) < FRAMES
