"""The command line: arguments, defaults, help, and messages about bad input."""

import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh
from room import BOUNDS, HALF
from room_files import BOX, wall_sdf_and_grad, write_depth, write_range

import hiosdf_jax as hio
from hiosdf_jax import datasets
from hiosdf_jax._src.command import cli, map_stream


@pytest.fixture
def given(monkeypatch):
    """What a run is given, instead of the run."""
    given = {}

    def run_stream(stream, config, output, **settings):
        given.update(settings, stream=stream, config=config, output=output)

    monkeypatch.setattr(map_stream, "run_stream", run_stream)
    return given


@pytest.mark.parametrize(
    ("backend", "name", "expected"),
    [("cpu", None, "light"), ("gpu", None, "default"), ("gpu", "light", "light")],
)
def test_the_device_chooses_the_configuration(
    tmp_path, given, monkeypatch, backend, name, expected
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    stream = write_range(tmp_path / "room.npz", 1)
    arguments = [] if name is None else ["--config", name]
    assert cli.main(["map", str(stream), *BOX, *arguments]) == 0
    assert given["config"] == getattr(hio.Config, expected)(BOUNDS, max_range=4.0)


def test_bounds_and_range_are_found_in_a_first_pass(tmp_path, given, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = write_depth(tmp_path / "turning.npz", 20)
    assert cli.main(["map", str(stream), "--voxel-size", "0.08"]) == 0
    config = given["config"]
    assert config.voxel_size == 0.08
    assert 1.0 < config.max_range < 3
    # The walls and the floor, with a margin of 0.3 m; y points down.
    low, high = config.bounds
    np.testing.assert_allclose([low[0], low[2]], [-HALF[0] - 0.3, -HALF[1] - 0.3], atol=0.02)
    np.testing.assert_allclose(high, HALF[[0, 2, 1]] + 0.3, atol=0.02)
    assert f"returns up to {config.max_range:.1f} m" in capsys.readouterr().out
    assert cli.main(["map", str(stream), "--max-range", "1.5"]) == 0
    assert (given["config"].bounds, given["config"].max_range) == (config.bounds, 1.5)
    assert (given["name"], given["truth"]) == ("turning.npz", None)


def test_the_first_frames_and_the_truth_of_the_file(tmp_path, given):
    stream = write_range(tmp_path / "room.npz", 6)
    assert cli.main(["map", str(stream), "--frames", "2", *BOX]) == 0
    assert (len(given["stream"]), len(given["truth"].sdf)) == (2, 500)
    assert cli.main(["map", str(stream), "--frames", "9", *BOX]) == 0
    assert len(given["stream"]) == 6


def test_a_mesh_replaces_the_truth_of_the_file(tmp_path, given):
    pytest.importorskip("igl")
    stream = write_range(tmp_path / "room.npz", 6)
    room = trimesh.creation.box(bounds=[-HALF, HALF])
    room.update_faces(np.arange(12) != 0)  # a hole: it is not watertight
    room.export(tmp_path / "room.ply")
    arguments = ["map", str(stream), "--ground-truth", str(tmp_path / "room.ply"), *BOX]
    assert cli.main(arguments) == 0
    truth = given["truth"]
    assert len(truth.sdf) == 25_000  # not the file's 500
    # Hardly any ray that meets a wall passes closest to the hole.
    error = truth.sdf - wall_sdf_and_grad(truth.points_world)[0]
    assert (error > -1e-6).all() and (error > 1e-6).mean() < 1e-3
    drawn = given["exact_sdf"](truth.points_world)  # unsigned: a sign would draw shadows
    np.testing.assert_allclose(drawn, truth.sdf, atol=1e-6)
    assert (given["exact_sdf"](np.add(truth.points_world, [3, 0, 0])) > 0).all()


def broken(tmp_path, kind):
    path = tmp_path / "stream.npz"
    if kind == "text":
        path.write_text("not a zip file")
    elif kind == "keys":
        np.savez(path, poses=np.eye(4)[None], depth=np.ones((1, 2, 2)))
    elif kind == "truth":
        arrays = dict(np.load(write_range(path, 2)))
        np.savez(path, **(arrays | {"eval_visible_sdf": np.ones(3)}))
    elif kind == "folder":
        path.mkdir()
    elif kind == "good":
        write_range(path, 2)
    return path


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        ("missing", [], "{stream}: No such file or directory"),
        ("folder", [], "{stream}: looks like no known format, expected one (npz: a file .npz; "),
        ("folder", ["--format", "npz"], "{stream}: Is a directory"),
        ("good", ["--format", "tum"], "{stream}/depth.txt: Not a directory"),
        ("good", ["--format", "las"], "format = 'las', expected one of ['npz', "),
        ("good", ["--world-frame", "map"], "world_frame is not an option of format 'npz'"),
        ("text", [], "{stream}: not a readable npz file"),
        ("keys", [], "{stream}: key 'K' is missing"),
        ("truth", [], "{stream}: eval_visible_sdf has shape (3,), expected (500,)"),
        (
            "good",
            ["--bounds", *"123023", "--max-range", "3"],
            "Config.bounds has x from 1.0 to 0.0",
        ),
        ("good", ["--voxel-size", "0"], "Config.voxel_size is 0.0, expected 0.001 <="),
        ("good", ["--save", "{folder}/none/map.npz"], "{folder}/none: no such folder"),
        ("good", ["--output", "{stream}", *BOX], "{stream}: File exists"),
        ("good", ["--ground-truth", "{folder}/none", *BOX], "{folder}/none: No such file"),
        ("good", ["--ground-truth", "{folder}", *BOX], "{folder}/sdf.npy: No such file"),
    ],
)
def test_bad_input(tmp_path, capsys, kind, arguments, message):
    names = {"stream": str(broken(tmp_path, kind)), "folder": str(tmp_path)}
    arguments = [argument.format(**names) for argument in arguments]
    assert cli.main(["map", names["stream"], *arguments]) == 2
    text = capsys.readouterr().err
    last = text.splitlines()[-1]
    assert last.startswith("hiosdf: " + message.format(**names))
    assert "Traceback" not in text
    if not {"--output", "--ground-truth"} & set(arguments):  # refused before any frame is read
        assert text.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["demo", "--frames", "0"],
        ["demo", "--config", "heavy"],
        ["demo", "--seed", "-1"],
    ],
)
def test_bad_arguments(capsys, arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert "usage: hiosdf" in capsys.readouterr().err


def test_help_of_the_module():
    result = subprocess.run(
        [sys.executable, "-m", "hiosdf_jax", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "demo" in result.stdout
    assert "map" in result.stdout


def test_help_names_all_formats(capsys):
    with pytest.raises(SystemExit):
        cli.main(["map", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert ", ".join(datasets.FORMATS[:-1]) + " or " + datasets.FORMATS[-1] in text


@pytest.mark.parametrize(
    ("command", "texts"),
    [
        ([], ["hiosdf demo --plan", "hiosdf map house_depth.npz"]),
        (["map"], ["default: light on a CPU, default on a GPU", "--ground-truth house.ply"]),
        (["demo"], ["default: light on a CPU, default on a GPU", "plan.gif"]),
    ],
)
def test_help_teaches_by_examples(capsys, command, texts):
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "examples:" in text
    for each in texts:
        assert each in " ".join(text.split())


@pytest.mark.parametrize(
    "module, package", [("jax_mppi", "jax-mppi"), ("skimage.graph", "scikit-image")]
)
def test_the_plan_names_the_package_that_it_misses(monkeypatch, tmp_path, capsys, module, package):
    for name in ("exploration", "driver"):
        monkeypatch.delitem(sys.modules, f"hiosdf_jax._src.demo.{name}", raising=False)
        monkeypatch.delattr(f"hiosdf_jax._src.demo.{name}", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(["demo", "--plan", "--output", str(tmp_path)]) == 2
    assert f"--plan needs {package}: in a clone, pip install '.[plan]'" in capsys.readouterr().err


def test_the_plan_has_no_frames_or_configuration(capsys):
    for option in (["--frames", "3"], ["--config", "light"]):
        assert cli.main(["demo", "--plan", *option]) == 2
        expected = f"hiosdf: {option[0]} cannot be combined with --plan"
        assert capsys.readouterr().err.strip() == expected
