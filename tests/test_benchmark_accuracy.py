"""The accuracy benchmark on a tiny stream; its gate, tables and command on made-up figures."""

import copy
import functools
import json
import math
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.image import imread
from room import CONFIG, HALF

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.accuracy import __main__ as command
from benchmarks.accuracy import figure, gate, gradient_parts, measure, results, sources, unseen
from hiosdf_jax import datasets, scoring
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.grid.lookup import grid_sdf
from hiosdf_jax._src.scoring import held_out, surface
from hiosdf_jax._src.state.pytrees import surface_of

FRAMES = 8
RAYS = 900  # per frame; the truth has as many points, so that one shape is compiled


def write_room(path, truth=True):
    """A LiDAR in an empty room."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, FRAMES)
    origins = poses[:, None, :3, 3]
    ranges = ((np.sign(directions) * HALF - origins) / directions).min(axis=-1)
    arrays = {"poses": poses, "range": ranges, "directions": directions, "range_scale": 1.0}
    if truth:
        frame, ray = rng.integers(0, FRAMES, RAYS), rng.integers(0, RAYS, RAYS)
        ends = poses[frame, :3, 3] + ranges[frame, ray, None] * directions[ray]
        points = poses[frame, :3, 3] + rng.uniform(size=(RAYS, 1)) * (ends - poses[frame, :3, 3])
        gaps = HALF - np.abs(points)
        grad = -np.sign(points) * (gaps == gaps.min(axis=-1, keepdims=True))
        arrays |= {"eval_visible": points, "eval_visible_sdf": gaps.min(axis=-1)}
        arrays |= {"eval_visible_grad": grad, "eval_visible_frame": frame, "eval_surface": ends}
    np.savez(path, **arrays)


@pytest.fixture
def tiny(monkeypatch):
    """Lets Config.light be the map of other tests, so that its update is compiled once for all."""
    given = []

    def light(cls, bounds, **overrides):
        given.append((bounds, overrides))
        return CONFIG

    monkeypatch.setattr(hio.Config, "light", classmethod(light))
    monkeypatch.setattr(measure, "EARLY_FRAMES", 4)
    monkeypatch.setattr(held_out, "_FIRST", 5)
    monkeypatch.setattr(surface, "_SEGMENTS", 20_000)
    return given


def test_a_stream_from_end_to_end(tmp_path, tiny, capsys):
    write_room(tmp_path / "room.npz")
    write_room(tmp_path / "real.npz", truth=False)
    output, baseline = tmp_path / "out" / "all.json", tmp_path / "baseline.json"
    arguments = ["--data", str(tmp_path), "--streams", "room", "real", "--every", "3"]
    arguments += ["--output", str(output), "--baseline", str(baseline)]
    assert command.main([*arguments, "--update-baseline"]) == 0
    assert imread(output.with_suffix(".png"))[..., :3].std() > 0.05

    # The same map, made and scored anew.
    path = tmp_path / "room.npz"
    stream, truth = datasets.NpzStream(path), datasets.read_truth(path)
    extent = datasets.find_bounds(stream)
    assert tiny[-1] == (extent.bounds, {"max_range": extent.max_range})
    states, state = [], hio.init(CONFIG, jax.random.key(0))
    order = np.random.default_rng(0)  # the seed is also that of the rows' order
    for cloud, pose in stream:
        state = hio.update(state, order.permutation(cloud), pose)
        states.append(state)

    def score(state, frame, **settings):
        query = functools.partial(hio.sdf_and_grad, hio.snapshot(state))
        return scoring.evaluate(query, truth, last_frame=frame, **settings)

    record, real = json.loads(output.read_text())
    assert (record["stream"], record["seed"], record["frames"]) == ("room", 0, FRAMES)
    blended = record["variants"]["blended"]
    expected = score(state, FRAMES - 1, sensor_position_world=[0.5, 0, 0])
    expected |= scoring.evaluate_lower(
        lambda points: hio.query(state, points).lower, truth, FRAMES - 1
    )
    expected["early_then_cm"] = score(states[3], 3)["visible_cm"]
    expected["early_now_cm"] = score(state, 3)["visible_cm"]
    found = hio.extract_mesh(state)
    expected |= scoring.evaluate_mesh(found, truth)
    queries = CompiledQueries(hio.snapshot(state))
    expected |= scoring.evaluate_steps(
        queries.sdf, queries.observed, CONFIG.bounds, found, CONFIG.voxel_size
    )
    assert blended["scores"] == pytest.approx(expected, rel=1e-4)
    assert [entry["frame"] for entry in blended["over_time"]] == [2, 5, 7]
    first = score(states[2], 2)["visible_cm"]
    assert blended["over_time"][0]["visible_cm"] == pytest.approx(first, rel=1e-4)
    assert blended["over_time"][0]["surface_cm"] is None  # NaN, which JSON does not have
    grid = record["variants"]["grid"]
    query_grid = jax.jit(grid_sdf, static_argnums=0)
    on_surface = query_grid(CONFIG, surface_of(state.grid), truth.surface_points_world)
    mean_cm = 100 * float(np.abs(on_surface).mean())
    assert grid["scores"]["surface_cm"] == pytest.approx(mean_cm, rel=1e-4)
    assert grid["bands"]["5-20 cm"]["visible_cm"] < 3
    assert record["variants"]["network"]["scores"]["visible_cm"] > grid["scores"]["visible_cm"]

    assert real["variants"]["blended"]["scores"].keys() == {
        "median_cm",
        "mean_cm",
        "p90_cm",
        "mesh_median_cm",
        "mesh_p90_cm",
    }
    held, order = hio.init(CONFIG, jax.random.key(0)), np.random.default_rng(0)
    for frame in (0, 1, 2, 3, 4, 6, 7):
        cloud, pose = stream[frame]
        held = hio.update(held, order.permutation(cloud), pose)
    cloud, pose = stream[5]
    returns = cloud + pose[:3, 3]
    observed = np.asarray(hio.query(held, returns).observed)
    error_cm = 100 * np.abs(query_grid(CONFIG, surface_of(held.grid), returns))[observed]
    assert len(error_cm) > 300 and np.median(error_cm) < 5
    median_cm = real["variants"]["grid"]["scores"]["median_cm"]
    assert median_cm == pytest.approx(np.median(error_cm), rel=1e-3)
    assert [entry["frame"] for entry in real["variants"]["grid"]["over_time"]] == [2, 7]
    assert list(scoring.held_out_frames(FRAMES)) == [5]

    saved = json.loads(baseline.read_text())
    assert saved["room"]["light"]["frames"] == FRAMES
    figures = saved["room"]["light"]["figures"]["blended"]
    assert figures["visible_cm"] == [blended["scores"]["visible_cm"]]
    assert figures["eikonal 0-5 cm"] == [blended["bands"]["0-5 cm"]["eikonal"]]
    assert "real" in saved
    assert "early_now_cm" in capsys.readouterr().out


# --- the command, without mapping ---


def made_up(source, config_name, seed, every, overrides):
    """What `measure` gives, with a different figure for each variant and seed."""
    visible = {"grid": 0.5, "network": 2.0, "blended": 1.0 + overrides.get("grid_share", 0)}
    variants = {}
    for name, value in visible.items():
        scores = {"visible_cm": value + 0.01 * seed, "recall": 0.9, "surface_cm": math.nan}
        over_time = [{"frame": frame, "visible_cm": value} for frame in (9, 19)]
        bands = {"0-5 cm": {"visible_cm": 0.3}, ">50 cm": {"visible_cm": 3.0}}
        variants[name] = {"scores": scores, "bands": bands, "over_time": over_time}
    return {
        "stream": source.name,
        "config_name": config_name,
        "overrides": overrides,
        "seed": seed,
        "frames": 20,
        "device": "cpu",
        "jax": jax.__version__,
        "revision": "abc1234",
        "variants": variants,
    }


@pytest.fixture
def unmapped(tmp_path, monkeypatch):
    (tmp_path / "house_depth.npz").touch()

    def opened(folder, name, frames):
        return sources.Source(name, None, None, None, complete=frames is None)

    monkeypatch.setattr(command, "open_source", opened)
    monkeypatch.setattr(command, "measure_source", made_up)
    monkeypatch.setattr(command.figure, "save_figure", lambda *_: False)  # other tests draw
    monkeypatch.chdir(tmp_path)
    return ["--data", ".", "--streams", "house_depth", "--baseline", "baseline.json"]


def test_the_gate_names_what_got_worse(unmapped, capsys):
    assert command.main(unmapped) == 0
    assert "house_depth light: not in the baseline" in capsys.readouterr().out
    assert not Path("baseline.json").exists()
    assert command.main([*unmapped, "--seeds", "0", "1", "--update-baseline"]) == 0
    assert command.main([*unmapped, "--seeds", "0", "1"]) == 0
    assert "12 figures compared" in capsys.readouterr().out  # 3 variants, but not the NaN
    saved = json.loads(Path("baseline.json").read_text())
    saved["house_depth"]["light"]["figures"]["blended"]["recall"] = [0.99, 0.99]
    saved["house_depth"]["light"]["figures"]["grid"]["visible_cm"] = [0.9, 0.9]
    Path("baseline.json").write_text(json.dumps(saved))
    assert command.main([*unmapped, "--seeds", "0", "1"]) == 1
    out = capsys.readouterr().out
    worse = out[out.index("WORSE") :].splitlines()
    assert worse[1] == "  house_depth light blended: recall 0.990 -> 0.900 (tolerance 0.050)"
    assert worse[2].startswith("12 figures")
    assert "house_depth light grid: visible_cm 0.90 -> 0.51" in out[: out.index("WORSE")]
    assert json.loads(Path("baseline.json").read_text()) == saved  # only the switch changes it


def test_a_change_is_compared_with_the_configuration_as_it_is(unmapped, capsys):
    assert command.main([*unmapped, "--update-baseline"]) == 0
    capsys.readouterr()
    assert command.main([*unmapped, "--override", "epochs=2"]) == 0
    assert command.main([*unmapped, "--override", "grid_share=0.5"]) == 1
    out = capsys.readouterr().out
    assert out.count("compared with the unchanged ones") == 2
    assert (
        out[out.index("WORSE") :]
        .splitlines()[1]
        .startswith("  house_depth light blended: visible_cm 1.00 -> 1.50")
    )


def test_peers_stand_beside_whole_streams_only(unmapped, capsys):
    command.main([*unmapped, "--seeds", "0", "2"])
    lines = capsys.readouterr().out.splitlines()
    heading = next(line for line in lines if line.startswith("stream "))
    assert heading.split()[:4] == ["stream", "map", "variant", "visible_cm"]
    blended = next(line.split() for line in lines if " blended " in line)
    assert blended[:4] == ["house_depth", "light", "blended", "1.01±0.01"]
    peer = next(line for line in lines if "HIO-SDF" in line)
    assert "2.97±0.1" in peer and "0.934" in peer
    near = next(line.split() for line in lines if " 0-5 cm" in line)
    assert near[-4:] == ["0-5", "cm", ">50", "cm"]
    assert any(line.split()[-2:] == ["0.30±0.00", "3.00±0.00"] for line in lines)
    command.main([*unmapped, "--frames", "3"])
    assert "HIO-SDF" not in capsys.readouterr().out


def test_an_ablation_is_one_table_and_has_no_gate(unmapped, capsys):
    arguments = [*unmapped, "--ablation", "grid_share", "--override", "voxel_size=0.2"]
    assert command.main(arguments) == 0
    out = capsys.readouterr().out
    blended = [line.split() for line in out.splitlines() if " blended " in line]
    rows = {row[3]: row[5] for row in blended if "±" not in row[5] and row[5][0].isdigit()}
    assert rows == {"0.0": "1.00", "0.5": "1.50", "0.8": "1.80", "0.9": "1.90", "1.0": "2.00"}
    assert out.count("visible_cm  ") >= 1 and out.count("\nstream ") == 2
    assert "not compared with the baseline" in out
    runs = json.loads(Path("hiosdf_output/accuracy.json").read_text())
    expected = [{"voxel_size": 0.2, "grid_share": share} for share in (0.0, 0.5, 0.8, 0.9, 1.0)]
    assert [run["overrides"] for run in runs] == expected


def test_figures_of_the_tables_are_written_by_configuration(unmapped, monkeypatch):
    monkeypatch.setattr(command, "_TABLES", Path("tables.json"))
    command.main([*unmapped, "--seeds", "0", "2", "--update-tables"])
    command.main([*unmapped, "--override", "grid_share=0.5", "--update-tables"])
    found = records.read(Path("tables.json"))["house_depth"]
    assert found.keys() == {"light", "light, grid_share=0.5"}
    assert found["light"]["seeds"] == [0, 2]
    assert found["light"]["mean"]["grid"] == {"visible_cm": 0.51, "recall": 0.9}
    assert found["light"]["half_range"]["grid"] == {"visible_cm": 0.01, "recall": 0.0}
    assert found["light, grid_share=0.5"]["mean"]["blended"]["visible_cm"] == 1.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--override", "voxels=1"], "Config has no field 'voxels'"),
        (["--override", "voxel_size=small"], "expected NAME=NUMBER"),
        (["--override", "voxel_size=0"], "Config.voxel_size is 0"),
        (["--override", "epochs=2", "--update-baseline"], "configurations as they are"),
        (["--ablation", "stages", "--update-baseline"], "configurations as they are"),
        (["--streams", "attic"], "attic.npz: no such file"),
        (["--frames", "0"], "0, expected at least 1"),
    ],
)
def test_bad_arguments(unmapped, capsys, arguments, message):
    with pytest.raises(SystemExit) as stop:
        command.main([*unmapped, *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("table", command.ABLATIONS)
def test_ablations_are_configurations(table):
    configs = [
        hio.Config.paper(((0, 0, 0), (1, 1, 1)), **row) for row in command.ABLATIONS[table].values()
    ]
    assert len(set(configs)) >= len(configs) - 1  # one row may be what paper is anyway


# --- the gate ---


def test_tolerance():
    # Pooled: s = sqrt((3 * 0.02^2 + 3 * 0.04^2) / 4), n = 3 on each side; three standard errors.
    old = np.array([1.0, 1.0, 1.0]) + 0.02 * np.array([-1, 0, 1]) * math.sqrt(1.5)
    new = np.array([1.0, 1.0, 1.0]) + 0.04 * np.array([-1, 0, 1]) * math.sqrt(1.5)
    pooled = math.sqrt((3 * 0.02**2 + 3 * 0.04**2) / 4)
    expected = 3 * pooled * math.sqrt(2 / 3)
    assert expected > 0.05
    assert gate.tolerance("visible_cm", old, new) == pytest.approx(expected)
    assert gate.tolerance("visible_cm >50 cm", [2.0], [2.5]) == pytest.approx(0.1)  # 5 %
    assert gate.tolerance("visible_cm", [0.1], [0.2]) == 0.02
    assert gate.tolerance("eikonal", [0.01], [0.02]) == 0.002
    assert gate.tolerance("visible_cm", [1.0, 1.2], [1.0]) == pytest.approx(
        3 * math.sqrt(2 * 0.1**2) * math.sqrt(1.5)
    )


def compared(metric, old, new):
    record = {"stream": "s", "config_name": "c", "frames": 3}
    scores = {} if new is None else {metric: new}
    record["variants"] = {"blended": {"scores": scores, "bands": {}, "over_time": []}}
    entry = {"frames": 3, "figures": {"blended": {metric: [old]}}}
    verdict = gate.compare({"s": {"c": entry}}, [record])
    return [len(lines) for lines in verdict[:3]]


@pytest.mark.parametrize(
    ("metric", "old", "new", "worse_better_skipped"),
    [
        ("visible_cm", 1.0, 1.04, [0, 0, 0]),
        ("visible_cm", 1.0, 1.06, [1, 0, 0]),
        ("visible_cm", 1.0, 0.94, [0, 1, 0]),
        ("recall", 0.9, 0.8, [1, 0, 0]),
        ("recall", 0.9, 1.0, [0, 1, 0]),
        ("near_bias_cm", -0.5, 0.5, [0, 0, 0]),
        ("near_bias_cm", 0.1, -0.2, [1, 0, 0]),
        ("near_bias_cm", -0.5, 0.1, [0, 1, 0]),
        ("visible_cm", 1.0, math.nan, [1, 0, 0]),
        ("thin_share", 0.5, None, [0, 0, 1]),
    ],
)
def test_which_way_is_worse(metric, old, new, worse_better_skipped):
    assert compared(metric, old, new) == worse_better_skipped


def test_other_frames_are_not_compared():
    record = {"stream": "s", "config_name": "c", "frames": 4, "variants": {}}
    verdict = gate.compare({"s": {"c": {"frames": 3, "figures": {}}}}, [record])
    assert verdict.skipped == ["s c: 4 frames, the baseline has 3"]
    assert verdict.compared == 0


def test_an_update_keeps_other_entries(tmp_path):
    source = sources.Source("room", None, None, None, True)
    first = [made_up(source, "light", seed, 1, {}) for seed in (0, 1)]
    gate.update_baseline(tmp_path / "b.json", first)
    gate.update_baseline(tmp_path / "b.json", [made_up(source, "paper", 5, 1, {})])
    baseline = records.read(tmp_path / "b.json")
    assert baseline["room"].keys() == {"light", "paper"}
    assert baseline["room"]["light"]["seeds"] == [0, 1]
    grid = baseline["room"]["light"]["figures"]["grid"]
    assert grid["visible_cm"] == [0.5, 0.51]
    assert "surface_cm" not in grid  # NaN is no figure
    assert gate.compare(baseline, first).worse == []


# --- tables, figure, imports ---


def test_figures_of_seeds():
    source = sources.Source("room", None, None, None, True)
    records = [made_up(source, "light", seed, 1, {}) for seed in (0, 3)]
    blended = results.figures_of(records)["blended"]
    assert blended["visible_cm"] == [1.0, 1.03]
    assert blended["visible_cm >50 cm"] == [3.0, 3.0]
    none = copy.deepcopy(records[:1])
    none[0]["variants"]["blended"]["scores"]["visible_cm"] = None  # as read from JSON
    assert math.isnan(results.figures_of(none)["blended"]["visible_cm"][0])


def test_peers_have_the_published_figures():
    peers = results.load_peers()
    assert peers["house_depth"]["Voxfield 10 cm"]["visible_cm"] == [3.09]
    assert peers["house_lidar"]["HIO-SDF"]["recall"] == [0.793]
    known = {key for systems in peers.values() for row in systems.values() for key in row}
    assert known <= scoring.METRICS.keys()


def test_figure(tmp_path):
    source = sources.Source("house_depth", None, None, None, True)
    groups = {
        ("house_depth", label): [made_up(source, label, seed, 1, {}) for seed in (0, 1)]
        for label in ("light", "paper")
    }
    assert figure.save_figure(tmp_path / "new" / "f.png", groups, results.load_peers())
    assert imread(tmp_path / "new" / "f.png")[..., :3].std() > 0.02


def test_it_needs_no_simulator_mesh_library_or_plotting():
    code = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        if name in ("mujoco", "trimesh", "skimage", "matplotlib", "igl"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Refuse())
import numpy as np
from pathlib import Path
from benchmarks import records
from benchmarks.accuracy import __main__, figure, sources
assert not figure.save_figure(Path("never.png"), {}, {})
from hiosdf_jax.scoring import GroundTruth
from hiosdf_jax.datasets import FrameStream
stream = FrameStream("s", 1, lambda i: (np.ones((3, 3)), np.eye(4)))
truth = GroundTruth(*5 * [np.zeros((0, 3))])
assert sources._with_mesh(Path(__main__.__file__), stream, truth, 9.0) == (truth, None)
"""
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "thin parts and meshes are not scored: trimesh" in done.stdout


def test_the_error_of_the_gradient_is_split_by_its_first_reason(monkeypatch):
    # A floor at z = 0 in the middle of a voxel, seen from above; and a lonely patch of two hits.
    config = hio.Config.light(((0, 0, 0), (1, 1, 1)), voxel_size=0.1)
    state = hio.init(config, jax.random.key(0))
    evidence = jax.tree.map(np.array, state.grid.evidence)
    evidence.hits[2:8, 2:8, 5] = 20
    evidence.axes[2:8, 2:8, 5] = 0.29 * np.diag([1, 1, 0.05])
    evidence.hits[2, 2, 5] = 2
    state = state.replace(grid=state.grid.replace(evidence=evidence))
    corner = np.asarray(config.corner_index) * config.voxel_size
    heights = [0.57, 0.57, 0.57, 0.53]
    points = corner + np.c_[[0.55, 0.25, 0.83, 0.45], [0.55, 0.25, 0.55, 0.45], heights]
    up = np.array([[0.0, 0.0, 1.0]] * 4)
    given = up.copy()
    given[3] *= -1
    monkeypatch.setattr(hio, "sdf_and_grad", lambda state, points: (points[:, 2], given))
    parts = gradient_parts.split_error(state, points, up, lambda at: at[:, 2] - corner[2] - 0.55)
    assert [part.share for part in parts.values()] == [0.25, 0, 0.25, 0.25, 0.25]
    assert [part.mean for part in parts.values()] == [2, 0, 0, 0, 0]
    bent = gradient_parts.split_error(state, points, up, lambda at: np.abs(at).max(axis=1))
    assert bent["the true gradient turns within 1.5 cm"].share > 0


def test_unseen_points_are_scored_by_their_depth(monkeypatch):
    config = hio.Config.light(((0, 0, 0), (1, 1, 1)), voxel_size=0.1)
    state = hio.init(config, jax.random.key(0))
    depth = np.array([-0.1, 0.1, 0.2, 0.3, 0.7])  # one seen, four unseen
    answer = hio.query(state, np.zeros((5, 3)))._replace(frontier=-depth)
    monkeypatch.setattr(hio, "query", lambda state, points: answer)
    errors = {"grid": 0.01, "network": 0.02}
    monkeypatch.setattr(
        unseen,
        "VARIANTS",
        {name: lambda field, at, m=m: (at[:, 0] + m, None) for name, m in errors.items()},
    )
    x = np.linspace(0.1, 0.9, 5)
    truth = scoring.GroundTruth(
        np.c_[x, x, x], x, np.zeros((5, 3)), np.zeros(5, int), np.zeros((0, 3))
    )
    rows = unseen.score_unseen(state, truth)
    assert [row["points"] for row in rows] == [2, 1, 1]
    assert rows[0]["error_cm"] == pytest.approx({"grid": 1, "network": 2}, rel=1e-3)
