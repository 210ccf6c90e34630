"""The measures of the robustness benchmark on made-up fields."""

import numpy as np
import pytest

from benchmarks.robustness import library, measures, scenes, vanishing
from benchmarks.robustness.library import Setup
from benchmarks.robustness.sensors import SENSORS, depth_camera, lidar
from benchmarks.robustness.worlds import Box, Capsule, World

# `library` is replaced by exact, hollow or shifted distances.


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
    place = measures.draw_old_place(EMPTY, [BOX], rng, 0.35)
    scores = measures.old_place(Made(EMPTY.distance), *place)
    assert scores == {"old": 1.0, "old_lower": 1.0, "old_network": 1.0}
    still_there = measures.old_place(
        Made(FULL.distance), *measures.draw_old_place(EMPTY, [BOX], rng)
    )
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
    # The camera sees the top of the box edge-on.
    nearest = points - truth[:, None] * measures._gradient(FULL, points)
    on_top = (np.abs(nearest - [3.9, 2.5, 1.2]) < [0.16, 0.31, 0.01]).all(axis=1)
    assert name != "camera" or not on_top.any()
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


def test_scans_are_counted_until_a_place_is_free(monkeypatch):
    names = ("old", "old_lower", "old_network")
    shares = [(0.9, 0.1, 0.0), (0.96, 0.2, 0.95), (0.9, 0.94, 1.0)]
    series = iter([dict(zip(names, each, strict=True)) for each in shares])
    monkeypatch.setattr(vanishing, "_SCANS_BEFORE", 1)
    monkeypatch.setattr(vanishing, "MOST_SCANS", 3)
    monkeypatch.setattr(Setup, "new_map", lambda setup, config: config.vanish_scans)
    monkeypatch.setattr(library, "play", lambda state, *_: library.Played(state, [], []))
    monkeypatch.setattr(library, "frontier", lambda state, points: points[:, 0])
    monkeypatch.setattr(measures, "old_place", lambda *_: next(series))
    found = vanishing.count_scans(Setup("light", 0), "camera", 6)
    assert found == {
        "sdf": (2, 0.9),
        "lower": (None, 0.94),
        "network": (2, 1),
        "frontier": (1, 1.0),
    }
