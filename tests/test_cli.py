"""The command, run as a user would on small streams; what it writes, says and answers."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

import hiosdf_jax as hio
from hiosdf_jax import datasets
from hiosdf_jax._src.command import cli, run
from hiosdf_jax.datasets import NpzStream

# A room without furniture; the sensor walks round in it.
LOW, HIGH = np.array([-1.2, -1.0, 0.0]), np.array([1.2, 1.0, 1.6])
BOX = ["--bounds", "-1.4", "-1.2", "-0.2", "1.4", "1.2", "1.8", "--max-range", "3"]
OUTPUTS = {"metrics.json", "slices.png", "mesh.ply", "mesh.png"}


def positions(frames):
    angle = 0.3 * np.arange(frames)
    return np.stack([0.4 * np.cos(angle), 0.3 * np.sin(angle), np.full(frames, 0.9)], axis=1)


def cast(origin, directions_world):
    """Distance along each ray to the walls of the room, (N,)."""
    with np.errstate(divide="ignore"):
        return np.where(
            directions_world > 0,
            (HIGH - origin) / directions_world,
            (LOW - origin) / directions_world,
        ).min(axis=-1)


def wall_sdf(points):
    gaps = np.concatenate([points - LOW, HIGH - points], axis=-1)
    nearest = gaps.argmin(axis=-1)
    return gaps.min(axis=-1), np.concatenate([np.eye(3), -np.eye(3)])[nearest]


def beams(count):
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def scan(frames):
    """Ranges (F, 600) of a LiDAR, its directions and its poses."""
    directions = beams(600)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = positions(frames)
    return np.stack([cast(pose[:3, 3], directions) for pose in poses]), directions, poses


def write_range(path, frames, truth=True):
    ranges, directions, poses = scan(frames)
    arrays = {"poses": poses, "range": ranges, "directions": directions, "range_scale": 1.0}
    if truth:
        rng = np.random.default_rng(1)
        share = rng.uniform(size=(500, 1))
        frame = rng.integers(0, frames, 500)
        beam = rng.integers(0, 600, 500)
        hits = poses[frame, :3, 3] + ranges[frame, beam, None] * directions[beam]
        points = poses[frame, :3, 3] + share * (hits - poses[frame, :3, 3])
        sdf, grad = wall_sdf(points)
        arrays |= {"eval_visible": points, "eval_visible_sdf": sdf, "eval_visible_grad": grad}
        arrays |= {"eval_visible_frame": frame, "eval_surface": hits}
    np.savez(path, **arrays)
    return path


def write_points(path, frames, empty=(), bad=(), stray=(0, 0, 0)):
    ranges, directions, poses = scan(frames)
    scans = [np.concatenate([each[:, None] * directions, [stray]]) for each in ranges]
    for i in empty:
        scans[i] = np.zeros((0, 3))
    poses[list(bad), 0, 0] = np.nan
    offsets = np.cumsum([0, *map(len, scans)])
    np.savez(
        path,
        poses=poses,
        points_mm=np.rint(1000 * np.concatenate(scans)).astype(np.int16),
        offsets=offsets,
    )
    return path


def write_depth(path, frames):
    """A camera that turns round and looks down, in a world whose y points down."""
    height, width, focal = 24, 32, 14.0
    v, u = np.indices((height, width))
    rays = np.stack([(u - 15.5) / focal, (v - 11.5) / focal, np.ones_like(u)], -1).reshape(-1, 3)
    poses, depth = [], []
    tilted_from_room = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for i, position in enumerate(positions(frames)):
        yaw, pitch = 0.6 * i, 0.5
        level = np.array([np.cos(yaw), np.sin(yaw), 0])
        forward = np.cos(pitch) * level - [0, 0, np.sin(pitch)]
        right = np.array([np.sin(yaw), -np.cos(yaw), 0])
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        depth.append(cast(position, rays @ rotation.T).reshape(height, width))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = tilted_from_room @ rotation, tilted_from_room @ position
        poses.append(pose)
    matrix = [[focal, 0, 15.5], [0, focal, 11.5], [0, 0, 1]]
    raw = np.rint(1000 * np.stack(depth)).astype(np.uint16)
    np.savez(path, poses=poses, depth=raw, K=np.array(matrix), depth_scale=1000.0)
    return path


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text("utf-8"))


def check_pictures(folder):
    assert {path.name for path in folder.iterdir()} == OUTPUTS
    for name in ("slices.png", "mesh.png"):
        picture = imread(folder / name)[..., :3]
        assert min(picture.shape[:2]) > 400
        assert picture.std() > 0.05  # something is on it


def test_map_with_ground_truth(tmp_path, capsys):
    stream = write_range(tmp_path / "room.npz", 6)
    output = tmp_path / "deep" / "out"
    assert cli.main(["map", str(stream), "--output", str(output), "--seed", "3", *BOX]) == 0
    check_pictures(output)
    metrics = metrics_of(output)
    assert (metrics["stream"], metrics["seed"], metrics["updates"]) == ("room.npz", 3, 6)
    assert metrics["frames_skipped"] == 0
    assert metrics["points_used"] == 6 * 600
    assert metrics["flags"] == []
    assert metrics["config"]["max_range"] == 3
    assert hio.Config(**metrics["config"]).bounds == ((-1.4, -1.2, -0.2), (1.4, 1.2, 1.8))
    assert 0 < metrics["update_median_ms"] <= metrics["update_p90_ms"]
    assert metrics["compile_s"] > metrics["update_p90_ms"] / 1000
    scores = metrics["scores"]
    assert scores["visible_cm"] < 6
    assert scores["within_3m_cm"] == pytest.approx(scores["visible_cm"])  # the room is that small
    assert set(metrics["bands"]) == {"0-5 cm", "5-20 cm", "20-50 cm", ">50 cm"}
    assert set(metrics["bands"][">50 cm"]) == {"visible_cm", "within_3m_cm", "eikonal", "cosine"}
    vertices = np.asarray(trimesh.load(output / "mesh.ply").vertices)
    assert np.median(np.abs(wall_sdf(vertices)[0])) < 0.06
    text = capsys.readouterr()
    assert "error, visible region" in text.out
    assert f"{scores['visible_cm']:.2f}" in text.out
    assert "mapping: 100%" in text.err


def test_map_against_a_mesh(tmp_path, monkeypatch):
    """It is scored by, and drawn beside, a mesh instead of what the file holds."""
    pytest.importorskip("igl")
    stream = write_range(tmp_path / "room.npz", 6)
    room = trimesh.creation.box(bounds=[LOW, HIGH])
    room.update_faces(np.arange(12) != 0)  # a hole: it is not watertight
    room.export(tmp_path / "room.ply")
    given = {}
    monkeypatch.setattr(run, "run_stream", lambda *_, **settings: given.update(settings))
    arguments = ["map", str(stream), "--ground-truth", str(tmp_path / "room.ply"), *BOX]
    assert cli.main(arguments) == 0
    truth = given["truth"]
    assert len(truth.sdf) == 25_000  # not the file's 500
    # But for few, no ray that met a wall passed nearest to the hole.
    error = truth.sdf - wall_sdf(truth.points_world)[0]
    assert (error > -1e-6).all() and (error > 1e-6).mean() < 1e-3
    drawn = given["exact_sdf"](truth.points_world)  # without a sign, which would draw shadows
    np.testing.assert_allclose(drawn, truth.sdf, atol=1e-6)
    assert (given["exact_sdf"](np.add(truth.points_world, [3, 0, 0])) > 0).all()


def test_map_only_the_first_frames(tmp_path, capsys):
    """And bad ones among them are told and passed over, points outside told and left out."""
    stream = write_points(tmp_path / "scans.npz", 8, empty=[2], bad=[4], stray=[0, 0, 2.5])
    arguments = ["map", str(stream), "--output", str(tmp_path / "out"), "--frames", "6"]
    assert cli.main([*arguments, *BOX, "--skip-bad-frames"]) == 0
    metrics = metrics_of(tmp_path / "out")
    assert (metrics["updates"], metrics["frames_skipped"]) == (4, 2)
    assert metrics["flags"] == ["POINTS_OUTSIDE"]
    assert (metrics["points_used"], metrics["points_outside"]) == (4 * 600, 4)
    assert "held_out" not in metrics  # too short to keep anything back
    text = capsys.readouterr()
    assert "frame 2: cloud has no finite row" in text.err
    assert f"frame 4: {stream}: poses[4]: pose has values that are not finite" in text.err
    assert "2 frames could not be used" in text.out
    assert "points in range fell outside the bounds and left no surface (4 of 2404)" in text.out


def test_map_without_ground_truth_in_a_tilted_world(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stream = write_depth(tmp_path / "turning.npz", 20)
    saved = tmp_path / "map.npz"
    arguments = ["map", str(stream), "--voxel-size", "0.08", "--save", str(saved)]
    assert cli.main(arguments) == 0
    output = tmp_path / "hiosdf_output" / "turning"
    check_pictures(output)
    metrics = metrics_of(output)
    assert metrics["updates"] == 19  # all but frame 15
    assert "scores" not in metrics
    assert metrics["held_out"]["points"] == 24 * 32
    assert metrics["held_out"]["points_observed"] > 600
    assert metrics["held_out"]["median_cm"] < 4
    assert metrics["config"]["voxel_size"] == 0.08
    assert 1.5 < metrics["config"]["max_range"] < 3
    np.testing.assert_allclose(metrics["up_world"], [0, -1, 0], atol=0.1)
    # The walls and the floor, with a margin of 0.3 m.
    low, high = metrics["config"]["bounds"]
    np.testing.assert_allclose([low[0], low[2]], [-1.5, -1.3], atol=0.02)
    np.testing.assert_allclose(high, [1.5, 0.3, 1.3], atol=0.02)
    text = capsys.readouterr()
    assert "held-out returns, median" in text.out
    assert "turned to be level" in text.out
    state = hio.load(saved)
    assert int(state.updates) == 19


def test_the_first_bad_frame_ends_the_run(tmp_path, capsys):
    """What was mapped before it is kept, and the exit code tells."""
    stream = write_points(tmp_path / "scans.npz", 5, bad=[3])
    output, saved = tmp_path / "out", tmp_path / "map.npz"
    arguments = ["map", str(stream), "--output", str(output), "--save", str(saved)]
    assert cli.main(arguments) == 2  # already while the bounds are found
    message = (
        f"hiosdf: frame 3: {stream}: poses[3]: pose has values that are not finite, "
        "expected T_world_sensor: "
    )
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(message)
    assert last.endswith("(--skip-bad-frames goes on without such frames)")
    assert not output.exists()
    assert cli.main([*arguments, *BOX]) == 2
    text = capsys.readouterr()
    assert text.err.splitlines()[-1] == last
    assert "ended early by frame 3: " in text.out
    check_pictures(output)
    metrics = metrics_of(output)
    assert (metrics["updates"], metrics["frames_skipped"]) == (3, 0)
    assert metrics["stopped_by"].startswith("frame 3: ")
    assert int(hio.load(saved).updates) == 3


def test_bad_frames_among_those_held_out(tmp_path):
    stream = NpzStream(write_points(tmp_path / "scans.npz", 4, bad=[2]))
    config = hio.Config.light(((-1.4, -1.2, -0.2), (1.4, 1.2, 1.8)), max_range=3.0)
    key = jax.random.key(0)
    mapped = run.map_frames(stream, config, key, held_out=[1, 2], skip_bad_frames=True)
    assert (int(mapped.state.updates), mapped.skipped, mapped.last_frame) == (2, 1, 3)
    cloud, pose = stream[1]
    assert mapped.held_out_world.shape == (600, 3)  # all but the stray one, too near
    expected = cloud[:600] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(np.sort(mapped.held_out_world, 0), np.sort(expected, 0), atol=1e-6)
    mapped = run.map_frames(stream, config, key, held_out=[1, 2])
    assert (int(mapped.state.updates), mapped.last_frame) == (1, 0)
    assert str(mapped.stopped).startswith("frame 2: ")


def test_no_usable_frame(tmp_path, capsys):
    stream = write_points(tmp_path / "scans.npz", 2, bad=[0, 1])
    arguments = ["map", str(stream), "--output", str(tmp_path / "out")]
    assert cli.main([*arguments, *BOX]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("hiosdf: frame 0: ")
    arguments.append("--skip-bad-frames")
    assert cli.main([*arguments, *BOX]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == "hiosdf: none of the 2 frames could be mapped"
    assert cli.main(arguments) == 1  # nor can bounds be found
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "hiosdf: none of the 2 frames can be used"


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
    if not {"--output", "--ground-truth"} & set(arguments):  # nothing was read before it
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


def test_help():
    result = subprocess.run(
        [sys.executable, "-m", "hiosdf_jax", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "demo" in result.stdout
    assert "map" in result.stdout


def test_help_tells_all_formats(capsys):
    with pytest.raises(SystemExit):
        cli.main(["map", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert ", ".join(datasets.FORMATS[:-1]) + " or " + datasets.FORMATS[-1] in text


def test_demo(tmp_path, capsys):
    output = tmp_path / "demo"
    assert cli.main(["demo", "--output", str(output), "--frames", "3", "--config", "light"]) == 0
    check_pictures(output)
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
    assert metrics["scores"]["visible_cm"] < 30  # three frames are few
    assert "collisions found" in capsys.readouterr().out
    picture = imread(output / "slices.png")
    assert picture.shape[1] > 1.3 * picture.shape[0]  # map, truth and error side by side
