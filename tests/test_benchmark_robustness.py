"""The benchmark of robustness: its worlds against oracles, its measures against made-up fields."""

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import hiosdf_jax as hio
from benchmarks.robustness import __main__ as command
from benchmarks.robustness import (
    apartment,
    faults,
    figures,
    gate,
    library,
    measures,
    movers,
    scenes,
)
from benchmarks.robustness.library import Frame, Played, Setup
from benchmarks.robustness.sensors import SENSORS, depth_camera, lidar, look_at, scan
from benchmarks.robustness.worlds import (
    BACKGROUND,
    Box,
    Capsule,
    Room,
    World,
    bounding_box,
    draw_inside,
    thing_distance,
)

THINGS = (
    Box((1.0, 0.4, 0.2), (0.3, 0.5, 0.4), 0.6),
    Box((-1.2, 0.3, -0.4), (0.2, 0.2, 0.9)),
    Capsule((0.0, -1.5, -0.5), (0.4, -1.1, 0.9), 0.25),
    Capsule((-0.5, 1.6, 0.0), (-0.5, 1.6, 0.0), 0.3),
)
WORLD = World(Room((-2.0, -2.5, -1.5), (2.5, 2.0, 1.5)), THINGS)


@pytest.fixture(scope="module")
def model():
    """The things of WORLD in MuJoCo."""
    geoms = []
    for thing in THINGS:
        if isinstance(thing, Box):
            place = f'pos="{_text(thing.center)}" euler="0 0 {thing.yaw}"'
            geoms.append(f'<geom type="box" size="{_text(thing.half)}" {place}/>')
        elif thing.start == thing.end:
            geoms.append(f'<geom type="sphere" size="{thing.radius}" pos="{_text(thing.start)}"/>')
        else:
            ends = _text((*thing.start, *thing.end))
            geoms.append(f'<geom type="capsule" size="{thing.radius}" fromto="{ends}"/>')
    xml = f"""<mujoco><compiler angle="radian"/>
      <worldbody>{"".join(geoms)}</worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def _text(values):
    return " ".join(map(str, values))


def _directions(count, seed=0):
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_rays_hit_where_those_of_mujoco_do(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    directions = _directions(4000)
    count = len(directions)
    for origin in ([0.1, 0.2, 0.3], [2.0, -2.0, 1.0], [-1.9, 1.9, -1.4]):
        ranges, geoms = np.empty(count), np.empty(count, np.int32)
        mujoco.mj_multiRay(
            m=model,
            d=data,
            pnt=np.array(origin),
            vec=directions.ravel(),
            geomgroup=None,
            flg_static=True,
            bodyexclude=-1,
            geomid=geoms,
            dist=ranges,
            normal=None,
            nray=count,
            cutoff=mujoco.mjMAXVAL,
        )
        mine, hit = WORLD.cast(np.array(origin), directions)
        np.testing.assert_array_equal(hit, geoms)
        assert (hit == BACKGROUND).any() and len(np.unique(hit)) >= 4
        np.testing.assert_allclose(mine[hit >= 0], ranges[hit >= 0], atol=1e-9)


def test_rays_that_miss_all_things_end_on_the_walls():
    directions = _directions(500)
    origin = np.array([0.1, 0.2, 0.3])
    ranges, hit = World(WORLD.background).cast(origin, directions)
    assert (hit == BACKGROUND).all()
    ends = origin + ranges[:, None] * directions
    np.testing.assert_allclose(WORLD.background.distance(ends), 0, atol=1e-12)


def test_rays_along_the_axes_hit_faces():
    world = World(Room((-1, -1, -1), (3, 1, 1)), (Box((2, 0, 0), (0.5, 0.5, 0.5)),))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    ranges, hit = world.cast(np.zeros(3), axes)
    np.testing.assert_allclose(ranges, [1.5, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(hit == 0, [True, False, False, False, False, False])


def test_distances_are_those_to_the_nearest_of_many_surface_points():
    """Rays from a point in all directions find no surface nearer than the distance."""
    directions = _directions(20_000)
    points = np.random.default_rng(1).uniform((-2, -2.5, -1.5), (2.5, 2, 1.5), (60, 3))
    points = points[WORLD.distance(points) > 0.02]
    assert len(points) > 30
    for point in points:
        distance = WORLD.distance(point[None])[0]
        least = WORLD.cast(point, directions)[0].min()
        assert distance - 1e-9 <= least <= 1.04 * distance + 0.002


def test_distances_inside_things_are_exact():
    """From inside, the surface is where the distance to the thing alone changes its sign."""
    rng = np.random.default_rng(2)
    for thing in THINGS:
        surface = _surface(thing, rng)
        inside = draw_inside(thing, 50, 0.01, rng)
        nearest = np.linalg.norm(inside[:, None] - surface, axis=-1).min(axis=1)
        np.testing.assert_allclose(-thing_distance(thing, inside), nearest, atol=0.02)


def _surface(thing, rng):
    """Points on the surface, by bisection from its center outward."""
    low, high = bounding_box(thing)
    center = (low + high) / 2
    directions = _directions(20_000)
    near, far = np.zeros(len(directions)), np.full(len(directions), 3.0)
    for _ in range(40):
        middle = (near + far) / 2
        inside = thing_distance(thing, center + middle[:, None] * directions) < 0
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return center + near[:, None] * directions


def test_points_drawn_inside_are_as_deep_as_asked():
    for thing in THINGS:
        points = draw_inside(thing, 300, 0.1, np.random.default_rng(0))
        assert points.shape == (300, 3)
        assert thing_distance(thing, points).max() <= -0.1
        low, high = bounding_box(thing)
        assert (points >= low).all() and (points <= high).all()


@pytest.mark.parametrize("name", SENSORS)
def test_scans_are_functions_of_their_seed_and_noise_is_as_said(name):
    sensor = SENSORS[name]()
    pose = look_at(np.array([1.4, 2.4, 0.9]), np.array([3.8, 2.5, 0.9]), sensor)
    world = World(scenes.ROOM, (Box((3.8, 2.5, 0.6), (0.25, 0.3, 0.6)),))
    first, again, other = (
        scan(sensor, world, pose, np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.cloud, again.cloud)
    assert not np.array_equal(first.cloud, other.cloud, equal_nan=True)
    np.testing.assert_allclose(world.distance(first.exact_world), 0, atol=1e-9)
    assert np.count_nonzero(first.hit == 0) > 100
    returned = np.isfinite(first.cloud).all(axis=1)
    assert 0.99 < returned.mean() < 1
    in_world = first.cloud[returned] @ pose[:3, :3].T + pose[:3, 3]
    off = np.linalg.norm(in_world - first.exact_world[returned], axis=1)
    ranges = np.linalg.norm(first.cloud[returned], axis=1)
    assert off.max() < 6 * sensor.sigma(ranges).max() * 1.8
    assert off.mean() > 0.3 * sensor.sigma(ranges * sensor.forward[returned]).mean()


def test_sensors_face_their_target():
    for sensor, axis in ((depth_camera(), 2), (lidar(), 0)):
        pose = look_at(np.array([1.0, 2.0, 0.9]), np.array([3.0, 1.0, 0.9]), sensor)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        np.testing.assert_allclose(pose[:3, axis], np.array([2, -1, 0]) / np.sqrt(5))
        down = pose[2, 1] if axis == 2 else -pose[2, 2]
        assert down == pytest.approx(-1)


def test_sensors_and_arm_stay_in_free_space():
    camera = depth_camera()
    static = World(scenes.ROOM, (movers._POST,))
    for k in range(60):
        tour = scenes.touring_path(camera, k)
        assert scenes.ROOM.distance(tour[None, :3, 3])[0] > 0.3
        pose = scenes.facing_path(camera, k)
        assert static.distance(pose[None, :3, 3])[0] > 0.3
    nearest = []
    rng = np.random.default_rng(0)
    for k in range(movers._ARM_SCANS):
        pose = scenes.facing_path(camera, k)
        parts = movers.arm_at(k, pose)
        centers, radii = movers.spheres_of(parts)
        for part in parts:
            inside = draw_inside(part, 300, 0.0, rng)
            reach = np.linalg.norm(inside[:, None] - centers, axis=-1) - radii
            assert reach.min(axis=1).max() < 0  # the spheres cover the arm
            assert thing_distance(part, pose[None, :3, 3])[0] > 0.15
        nearest.append((static.distance(centers) - radii).min())
    assert 0.02 < min(nearest) < 0.12  # it comes near the post and never touches it


def test_the_apartment_is_the_demos_and_its_things_move():
    home = apartment.Apartment()
    directions = _directions(200)
    origin = np.array([1.8, 1.5, 1.2])
    ends = origin + home.cast(origin, directions)[:, None] * directions
    np.testing.assert_allclose(home.distance(ends), 0, atol=1e-6)
    before = apartment.world_at(home, apartment._CHAIR_MOVES - 1)
    after = apartment.world_at(home, apartment._DOOR_OPENS.stop)
    middle_of_doorway = np.array([[5.65, 1.325, 1.0]])
    assert before.distance(middle_of_doorway)[0] < 0
    assert after.distance(middle_of_doorway)[0] > 0.35
    assert before.things[1] != after.things[1]
    for k in apartment._WALK:
        person = apartment.person_at(k)
        assert home.distance(draw_inside(person, 200, 0.01, np.random.default_rng(0))).min() > 0


# Fields that are made up: `library` is replaced by exact, hollow or shifted distances.


class Made:
    """Answers like a map, by a distance function."""

    def __init__(self, distance, network=None, slack=0.03):
        self.distance, self.slack = distance, slack
        self.network = network or distance


@pytest.fixture
def made(monkeypatch):
    monkeypatch.setattr(library, "sdf", lambda state, points: state.distance(points))
    monkeypatch.setattr(library, "solid_sdf", lambda state, points: state.distance(points))
    monkeypatch.setattr(library, "network_sdf", lambda state, points: state.network(points))
    monkeypatch.setattr(
        library, "lower", lambda state, points: state.distance(points) - state.slack
    )

    def sdf_and_grad(state, points):
        sides = [
            state.distance(points + step) - state.distance(points - step)
            for step in 1e-4 * np.eye(3)
        ]
        return state.distance(points), np.stack(sides, axis=1) / 2e-4

    monkeypatch.setattr(library, "solid_sdf_and_grad", sdf_and_grad)


BOX = Box((3.8, 2.5, 0.6), (0.25, 0.3, 0.6))
EMPTY, FULL = World(scenes.ROOM), World(scenes.ROOM, (BOX,))


def _hollow(points):
    """The box as its surface only."""
    return np.abs(FULL.distance(points))


def _scans(world, count=3):
    setup = Setup("light", 0)
    return scenes.scan_all(setup, depth_camera(), lambda _: world, range(count))


def test_a_perfect_field_is_solid_and_a_hollow_one_is_not(made):
    perfect, hollow = (
        measures.solidity(Made(field), BOX, np.random.default_rng(0))
        for field in (FULL.distance, _hollow)
    )
    assert perfect == {"solid": 1.0, "solid_lower": 1.0, "outward": 1.0, "pushed_out": 1.0}
    assert hollow["solid"] == hollow["outward"] == 0 and hollow["pushed_out"] < 0.05
    assert hollow["solid_lower"] < 0.05


def test_the_visible_side_is_scored_by_its_error(made):
    scans = _scans(FULL)
    right = Made(FULL.distance, network=lambda points: FULL.distance(points) - 0.04)
    scores = measures.visible_side(right, scans, [0])
    assert scores["side_cm"] == pytest.approx(0, abs=1e-6)
    assert scores["side_network_cm"] == pytest.approx(4)
    assert scores["side_lower"] == 1
    wrong = Made(EMPTY.distance, slack=0.0)
    scores = measures.visible_side(wrong, scans, [0])
    assert scores["side_cm"] > 30 and scores["side_lower"] < 0.01
    none = measures.visible_side(wrong, _scans(EMPTY), [0])
    assert np.isnan(none["side_cm"])


def test_an_old_place_must_reach_its_true_distance(made):
    rng = np.random.default_rng(0)
    scores = measures.old_place(Made(EMPTY.distance), EMPTY, [BOX], rng, 0.35)
    assert scores == {"old": 1.0, "old_lower": 1.0, "old_network": 1.0}
    still_there = measures.old_place(Made(FULL.distance), EMPTY, [BOX], rng)
    assert max(still_there.values()) < 0.02


@pytest.mark.parametrize("name", SENSORS)
def test_seen_points_are_free_and_their_nearest_surface_was_seen(made, name):
    sensor = SENSORS[name]()
    scans = scenes.scan_all(Setup("light", 0), sensor, lambda _: FULL, range(3))
    points, truth = measures.seen_points(sensor, scans, FULL, np.random.default_rng(0))
    assert len(points) > 2000 and (truth >= -1e-9).all()
    assert measures.bounds_hold(Made(FULL.distance), points, truth) == {
        "coverage": 1.0,
        "slack_cm": pytest.approx(3),
    }
    loose = measures.bounds_hold(Made(FULL.distance, slack=-0.01), points, truth)
    assert loose["coverage"] == 0 and loose["slack_cm"] == pytest.approx(-1)
    # What no scan saw is not asked: the back of the box and what lies behind it.
    behind = points[np.abs(points - [4.2, 2.5, 0.6]).max(axis=1) < 0.1]
    assert len(behind) == 0
    back = np.array([[4.05, 2.5, 0.6]])
    front = np.array([[3.55, 2.5, 0.6]])
    poses = [each.pose for each in scans]
    wide = sensor if name == "camera" else lidar(rings=64)
    assert not measures.is_visible(wide, poses, FULL, back)[0]
    assert measures.is_visible(wide, poses, FULL, front)[0]


def test_errors_are_compared_with_those_of_the_clean_map(made):
    points = np.random.default_rng(0).uniform((1, 1, 0.5), (3, 4, 2), (500, 3))
    truth = EMPTY.distance(points)
    clean = Made(lambda points: EMPTY.distance(points) + 0.01)
    low = Made(lambda points: EMPTY.distance(points) - 0.03)
    scores = measures.error_ratio(low, clean, points, truth)
    assert scores == {"error_ratio": pytest.approx(3), "bias_cm": pytest.approx(-3)}


def test_a_wake_is_where_the_thing_was_and_is_not(made):
    placements = [Box((3.8, 1.0 + 0.2 * k, 0.6), (0.25, 0.3, 0.6)) for k in range(8)]
    worlds = [World(scenes.ROOM, (each,)) for each in placements]
    setup = Setup("light", 0)
    scans = scenes.scan_all(setup, depth_camera(), lambda k: worlds[k], range(8))
    clean, trail = (measures.Wake(placements, 3, setup.rng(1)) for _ in range(2))
    everything = World(scenes.ROOM, tuple(placements))
    for k in range(8):
        clean.look(Made(worlds[k].distance), k, worlds[k], scans[k])
        trail.look(Made(everything.distance), k, worlds[k], scans[k])
    right, wrong = clean.figures(), trail.figures()
    assert right["worst_ghost"] == 0 and right["worst_side_cm"] == pytest.approx(0, abs=1e-6)
    # At the end the places 0 to 4 have been left: 0.8 + 0.6 m of them, 0.3 m of which is the box.
    expected = (placements[4].center[1] + 0.3 - 0.7 - 0.2) / 0.6
    assert wrong["worst_ghost"] == pytest.approx(expected, rel=0.15)
    assert 0 < wrong["ghost"] < wrong["worst_ghost"]


def test_ghosts_of_the_arm_are_counted_in_free_space_only(made):
    rng = np.random.default_rng(0)
    swept = [Capsule((2.0, 2.0, 1.2), (2.2, 2.0, 1.2), 0.05)]
    assert measures.ghosts(Made(EMPTY.distance), EMPTY, swept, rng) == {"arm_ghost": 0}
    left = World(scenes.ROOM, tuple(swept))
    assert measures.ghosts(Made(left.distance), EMPTY, swept, rng) == {"arm_ghost": 1}


def test_things_are_kept_or_lost(made):
    scans = _scans(FULL)
    assert measures.kept(Made(FULL.distance), scans, [0]) == {"kept": 1.0}
    assert measures.kept(Made(EMPTY.distance), scans, [0])["kept"] < 0.05


def test_moving_rows_are_counted():
    seen = _scans(FULL, 1)[0]
    exact, half = measures.RowCounts(), measures.RowCounts()
    exact.look(seen.hit == 0, seen)
    half.look(np.full(len(seen.hit), True), seen)
    assert exact.figures() == {"row_recall": 1.0, "row_precision": 1.0}
    assert half.figures()["row_recall"] == 1
    assert half.figures()["row_precision"] == pytest.approx(np.mean(seen.hit == 0), rel=0.05)
    silent = measures.RowCounts()
    silent.look(None, seen)
    assert silent.figures() == {}


@pytest.fixture
def stream():
    setup = Setup("light", 0)
    scans = scenes.scan_all(
        setup, depth_camera(20, 15), lambda _: EMPTY, range(40), scenes.touring_path
    )
    frames = scenes.frames_of(scans)
    return faults.Stream("room", scenes.BOUNDS, 9.0, frames, np.zeros((1, 3)), np.zeros(1))


def test_bursts_are_functions_of_their_seed(stream):
    for label, burst in faults.BURSTS.items():
        first, again = (burst(stream, np.random.default_rng(0)) for _ in range(2))
        assert len(first) in (1, 5, 10), label
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a.cloud, b.cloud)
            np.testing.assert_array_equal(a.pose, b.pose)
            assert np.isfinite(a.cloud).all(axis=1).any()
    covered = faults.BURSTS["lens covered for 5 frames"](stream, np.random.default_rng(0))[0]
    assert np.nanmax(np.abs(covered.cloud[:, 2] - 0.12)) < 0.02
    off = faults.BURSTS["5 frames 1 m off"](stream, np.random.default_rng(0))[0]
    assert np.linalg.norm(off.pose[:3, 3] - stream.frames[25].pose[:3, 3]) == pytest.approx(1)


def test_steady_faults_do_what_they_say(stream):
    frame = stream.frames[1]
    spoiled = {
        label: spoil(frame, 1, np.random.default_rng(0))
        for label, (spoil, _) in faults.STEADY.items()
    }
    lost = np.isnan(spoiled["30 % drop-outs"].cloud[:, 0]).mean()
    assert 0.2 < lost < 0.4
    wrong = np.abs(spoiled["5 % outliers"].cloud - frame.cloud).max(axis=1) > 1e-3
    assert 0.01 < wrong.mean() < 0.1
    ranges = np.linalg.norm(frame.cloud, axis=1)
    off = np.linalg.norm(spoiled["5 cm noise"].cloud, axis=1) - ranges
    assert np.nanstd(off) == pytest.approx(0.05, rel=0.2)
    turned = spoiled["poses 2 cm and 1 degree off"].pose
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-9)
    assert 0 < np.linalg.norm(turned[:3, 3] - frame.pose[:3, 3]) < 0.1
    every_other = faults.STEADY["5 cm noise every other frame"][0]
    assert every_other(frame, 0, np.random.default_rng(0)) is frame


def test_alarms_of_the_clean_stream_are_none():
    clean = faults.Clean(None, None, int(hio.Flag.POINTS_OUTSIDE))
    outside, bad = int(hio.Flag.POINTS_OUTSIDE), int(hio.Flag.BAD_POSE)
    played = Played(None, [outside, bad, 0, 0], [None, None, "a message", None])
    assert faults._alarm(clean, played) == {"flagged": 0.5}
    assert faults._alarm(clean, played, 1) == {"flagged": 0}


def test_a_map_is_played_and_its_flags_are_those_of_each_update(monkeypatch):
    given = []

    def update(state, cloud, pose, **extras):
        given.append(extras)
        if pose is None:
            raise ValueError("no pose")
        flags = state.report.flags | np.uint32(2 if len(cloud) == 0 else 0)
        return _State(flags)

    class _State(SimpleNamespace):
        def __init__(self, flags):
            report = SimpleNamespace(flags=np.uint32(flags))
            report.replace = lambda flags: SimpleNamespace(flags=flags)
            super().__init__(report=report)

        def replace(self, report):
            return _State(report.flags)

    monkeypatch.setattr(hio, "update", update)
    monkeypatch.setattr(library, "_ACCEPTED", frozenset({"noise"}))
    some = np.zeros((2, 3))
    frames = [
        Frame(some[:0], np.eye(4)),
        Frame(some, np.eye(4), noise=(0.05, 0.0), robot=(some, some[:, 0])),
        Frame(some, None),
    ]
    played = library.play(_State(0), frames, "test")
    assert played.flags == [2, 0, 0]
    assert played.refused == [None, None, "no pose"]
    assert given == [{}, {"noise": (0.05, 0.0)}, {}]


def test_bars_are_checked_for_each_row():
    results = {
        "appears after 1, camera": {
            "solid": [1.0, 0.99],
            "solid_lower": [0.5],
            "pushed_out": [1.0],
            "side_cm": [0.5],
            "coverage": [0.995],
            "slack_cm": [7.0],
        },
        "walks, lidar": {"side_cm": [1.0]},
    }
    checks = {(each.row, each.bar.figure): each.met for each in figures.check(results)}
    assert checks["appears after 1, camera", "solid"]
    assert not checks["appears after 1, camera", "solid_lower"]
    assert not checks["appears after 1, camera", "slack_cm"]
    assert not checks["walks, lidar", "row_recall"]  # not measured is not met
    assert ("walks, lidar", "coverage") not in checks
    table = figures.format_tables({"some": results})
    assert "0.5!" in table and "7!" in table


def test_every_bar_is_about_a_known_figure():
    assert {bar.figure for bar in figures.BARS} <= set(figures.FIGURES)


def test_the_gate_finds_what_got_worse(tmp_path):
    old = {"row": {"solid": [0.99], "side_cm": [1.0], "bias_cm": [-0.5], "error_ratio": [2.0]}}
    same = gate.compare(old, old)
    assert same == gate.Verdict([], [], 4)
    new = {"row": {"solid": [0.9], "side_cm": [0.5], "bias_cm": [0.6]}, "other": {"solid": [0.0]}}
    verdict = gate.compare(old, new)
    assert len(verdict.worse) == 2  # solid, and error_ratio is missing
    assert verdict.better == ["row: side_cm 1 -> 0.5"]
    path = tmp_path / "baseline.json"
    record = {"device": "cpu", "jax": "0", "seeds": [0], "rows": old}
    gate.update_baseline(path, "light", record)
    gate.update_baseline(path, "light", record | {"rows": {"more": {"solid": [1.0]}}})
    gate.update_baseline(path, "default", record)
    loaded = json.loads(path.read_text("utf-8"))
    assert loaded["light"]["rows"] == old | {"more": {"solid": [1.0]}}
    assert set(loaded) == {"light", "default"}


def test_the_command_runs_a_scenario_and_compares(tmp_path, monkeypatch, capsys):
    rows = {"appears after 1, camera": {"solid": 0.2, "side_cm": 1.0}}
    monkeypatch.setattr(command, "scenarios", lambda data: {"appear": lambda setup: rows})
    baseline, output = tmp_path / "baseline.json", tmp_path / "run.json"
    arguments = ["--baseline", str(baseline), "--output", str(output), "--seeds", "0", "1"]
    assert command.main([*arguments, "--update-baseline"]) == 0
    assert json.loads(output.read_text("utf-8"))["light"]["rows"] == {
        "appears after 1, camera": {"solid": [0.2, 0.2], "side_cm": [1.0, 1.0]}
    }
    assert command.main(arguments) == 0
    assert command.main([*arguments, "--bars"]) == 1
    assert "MISSED appears after 1, camera: solid 0.2" in capsys.readouterr().out
    rows["appears after 1, camera"]["solid"] = 0.1
    assert command.main(arguments) == 1
    assert "WORSE" in capsys.readouterr().out
