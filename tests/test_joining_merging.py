"""Maps that move: in another frame, added up, corrected after a loop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, CONFIG, arrays_equal, ask, distances, map_of_room, room_sdf, stream
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.grid import patches
from hiosdf_jax._src.mapping.joining import merging

EYE = np.eye(4, dtype=np.float32)
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (400, 3)).astype(np.float32)


def pose_of(rotvec, shift):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), shift
    return pose


def moved_points(pose, points):
    return (points @ np.asarray(pose)[:3, :3].T + np.asarray(pose)[:3, 3]).astype(np.float32)


def error_cm(state, points=POINTS, exact=None):
    exact = room_sdf(points) if exact is None else exact
    return 100 * np.abs(distances(state, points) - exact).mean()


@pytest.fixture(scope="module")
def halves():
    """Two maps, of alternate frames."""
    frames = stream(24, 300)
    states = [hio.init(CONFIG, jax.random.key(k)) for k in range(2)]
    for i, frame in enumerate(frames):
        states[i % 2] = hio.update(states[i % 2], *frame)
    return states


@pytest.fixture(scope="module")
def merged(halves):
    return hio.merge(*halves, EYE)


def test_the_identity_keeps_the_map(room_map):
    same = hio.transform(room_map, EYE)
    known = np.asarray(room_map.grid.evidence.hits) > 0
    for name in ("hits", "passes", "behind", "root_weight", "mean", "axes"):
        before, after = (
            np.asarray(getattr(state.grid.evidence, name)) for state in (room_map, same)
        )
        if name in ("mean", "axes"):
            before, after = before[known], after[known]
        np.testing.assert_array_equal(after, before, err_msg=name)
    for name in ("nearest", "sdf", "side", "doubt", "frontier_steps"):
        before, after = (getattr(state.grid.derived, name) for state in (room_map, same))
        np.testing.assert_array_equal(after, before, err_msg=name)
    assert arrays_equal(same.network, room_map.network)
    for part in ("report", "key", "updates", "optimism"):
        assert arrays_equal(getattr(same, part), getattr(room_map, part)), part
    assert arrays_equal(ask(same, POINTS), ask(room_map, POINTS))


def test_surfaces_that_leave_the_box_are_reported(room_map):
    """A shift by 0.6 m loses one wall and parts of four sides; one by 5 m loses all."""
    for shift, least in ((0.6, 0.1), (5.0, 1.0)):
        with pytest.warns(UserWarning, match="% of the surface patches fall outside") as caught:
            moved = hio.transform(room_map, pose_of((0, 0, 0), (shift, 0, 0)))
        share = float(str(caught[0].message).split()[0]) / 100
        lost = 1 - features(moved) / features(room_map)
        np.testing.assert_allclose(share, lost, atol=0.01)
        assert share >= least
        assert hio.Flag.POINTS_OUTSIDE in hio.Flag(moved.report.update_flags)


def test_a_larger_box_loses_no_surface(room_map):
    bounds = tuple(tuple(6 * np.array(corner)) for corner in BOUNDS)
    # The flag of the last cloud says nothing of the moved map.
    flags = jnp.uint32(hio.Flag.POINTS_OUTSIDE)
    room_map = room_map.replace(report=room_map.report.replace(update_flags=flags))
    moved = hio.transform(room_map, pose_of((0, 0, 0), (2, 0, 0)), bounds)
    assert features(moved) == features(room_map)
    assert hio.Flag.POINTS_OUTSIDE not in hio.Flag(moved.report.update_flags)


def features(state):
    """Number of the voxels whose patch counts as surface."""
    known = state.grid.evidence
    hits, passes, root_weight = (
        jnp.asarray(part, jnp.float32) for part in (known.hits, known.passes, known.root_weight)
    )
    surface = patches.is_feature(state.config, hits, passes, root_weight**2, known.axes)
    return int(jnp.sum(surface))


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0, 0, np.pi)])
def test_whole_voxels_and_half_turns_answer_as_before(room_map, rotvec):
    """The box of the room is symmetric: nothing leaves it by a half turn."""
    pose = pose_of(rotvec, (0.1, -0.1, 0.0))
    moved = hio.transform(room_map, pose)
    inner = (np.abs(POINTS) < 0.4).all(axis=1)  # what left the box is far from here
    there = ask(moved, moved_points(pose, POINTS))
    here = ask(room_map, POINTS)
    np.testing.assert_allclose(there.sdf[inner], here.sdf[inner], atol=2e-3)
    assert np.mean(np.abs(there.sdf - here.sdf)[inner]) < 2e-4


def test_an_oblique_move_loses_little_and_says_so_by_frontier(sharp_map):
    pose = pose_of((0.2, -0.1, 0.7), (0.05, 0.02, -0.04))
    with pytest.warns(UserWarning, match="12 % of the surface patches"):
        moved = hio.transform(sharp_map, pose)
    there = moved_points(pose, POINTS)
    assert error_cm(moved, there, room_sdf(POINTS)) < 1.5 * error_cm(sharp_map) + 0.2
    seen, before = (ask(*pair).observed for pair in ((moved, there), (sharp_map, POINTS)))
    assert (seen & ~before).mean() < 0.02
    assert seen.mean() > 0.6 * before.mean()


def test_two_halves_are_as_good_as_one_pass(halves, merged):
    one = map_of_room(CONFIG, jax.random.key(0), 24, 300)
    assert int(merged.updates) == 24
    hits, expected = (np.asarray(s.grid.evidence.hits, float) for s in (merged, one))
    assert hits.sum() == pytest.approx(expected.sum(), rel=0.05)
    assert error_cm(merged) < min(error_cm(half) for half in halves)
    assert error_cm(merged) < 1.15 * error_cm(one) + 0.1
    assert hio.Flag(merged.report.flags) == 0


def test_a_merged_map_can_be_updated(merged, tmp_path):
    hio.save(tmp_path / "map.npz", merged)
    loaded = hio.load(tmp_path / "map.npz")
    assert arrays_equal(loaded, merged)
    after = hio.update(loaded, *stream(1)[0])
    assert int(after.updates) == 25 and int(after.report.update_flags) == 0


def test_an_empty_map_adds_nothing(room_map, empty_map):
    for pair in ((room_map, empty_map), (empty_map, room_map)):
        total = hio.merge(*pair, EYE)
        assert int(total.updates) == 4
        assert arrays_equal(total.network, room_map.network)
        assert arrays_equal(ask(total, POINTS), ask(room_map, POINTS))


def test_a_thing_that_one_map_has_met_is_solid_in_both_orders(halves):
    """The other map has seen through it."""
    free = halves[0]
    thing = np.zeros(CONFIG.grid_shape, bool)
    thing[11:14, 9:12, 7:10] = True
    known = free.grid.evidence
    axes = np.where(thing[..., None, None], 0.3 * np.eye(3), 0)
    met = empty = hio.forget(free, ((-9, -9, -9), (9, 9, 9)))
    met = empty.replace(
        grid=empty.grid.replace(
            evidence=empty.grid.evidence.replace(
                hits=jnp.asarray(5 * thing, known.hits.dtype),
                root_weight=jnp.asarray(2 * thing, known.hits.dtype),
                axes=jnp.asarray(axes, known.axes.dtype),
            )
        )
    )
    assert (np.asarray(known.passes)[thing] > 0).all()
    for pair in ((free, met), (met, free)):
        total = hio.merge(*pair, EYE).grid.evidence
        hits, passes, root_weight = (
            x.astype(jnp.float32) for x in (total.hits, total.passes, total.root_weight)
        )
        surface = patches.is_feature(CONFIG, hits, passes, root_weight**2, total.axes)
        assert np.asarray(surface)[thing].all()


def test_correct_puts_submaps_where_they_belong(halves, merged):
    """Two submaps with frames of their own, of which one is off by whole voxels."""
    off = pose_of((0, 0, 0), (0.1, 0.0, 0.0))
    submaps = [halves[0], hio.transform(halves[1], off)]
    fixed = hio.correct(submaps, np.stack([np.eye(4), np.linalg.inv(off)]))
    assert int(fixed.updates) == 24
    wrong = hio.correct(submaps, np.stack([np.eye(4)] * 2))
    # At 2,000 points the ratio of two errors is uncertain by several percent.
    many = np.random.default_rng(1).uniform(-0.5, 0.5, (10, 2000, 3)).astype(np.float32)
    good, bad, best = (
        np.mean([error_cm(state, points) for points in many]) for state in (fixed, wrong, merged)
    )
    assert good < 1.1 * best + 0.1
    assert good < 0.8 * bad


def test_inside_jit_a_bad_pose_is_flagged_and_adds_nothing(room_map, empty_map):
    bad = np.full((4, 4), np.nan, np.float32)  # not weakly typed: no compilation of its own
    for call in (hio.transform, lambda state, pose: hio.merge(state, state, pose)):
        assert jax.eval_shape(call, room_map, bad).config == CONFIG
    # What these run inside the user's jit, compiled once for all tests.
    kept, _ = merging._join_jit(CONFIG, ((room_map, bad),))
    total, _ = merging._join_jit(CONFIG, ((empty_map, None), (room_map, bad)))
    for state, expected in ((kept, room_map), (total, empty_map)):
        assert hio.Flag.BAD_POSE in hio.Flag(state.report.update_flags)
        assert arrays_equal(state.grid.evidence.hits, expected.grid.evidence.hits)
        assert int(state.updates) == int(expected.updates)


BAD_POSES = [np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), np.eye(3), "pose"]


@pytest.mark.parametrize("pose", BAD_POSES)
def test_a_bad_pose_is_refused(room_map, pose):
    with pytest.raises(ValueError, match="pose"):
        hio.transform(room_map, pose)
    with pytest.raises(ValueError, match="pose_a_b"):
        hio.merge(room_map, room_map, pose)
    poses = pose if isinstance(pose, str) else [pose]
    with pytest.raises(ValueError, match="poses"):
        hio.correct([room_map], poses)


def test_what_does_not_fit_is_refused(room_map):
    coarse = hio.init(dataclasses.replace(CONFIG, voxel_size=0.2), jax.random.key(0))
    with pytest.raises(ValueError, match=r"b has Config.voxel_size 0.2, expected that of a, 0.1"):
        hio.merge(room_map, coarse, EYE)
    deep = hio.init(dataclasses.replace(CONFIG, hidden_layers=2), jax.random.key(0))
    with pytest.raises(ValueError, match=r"submaps\[1\] has Config.hidden_layers 2"):
        hio.correct([room_map, deep], [EYE, EYE])
    with pytest.raises(ValueError, match="b is Field, expected a MapState"):
        hio.merge(room_map, hio.snapshot(room_map), EYE)
    with pytest.raises(ValueError, match="submaps is empty, expected a list of maps, at least 1"):
        hio.correct([], np.zeros((0, 4, 4)))
    with pytest.raises(ValueError, match=r"poses has shape \(2, 4, 4\), expected \(1, 4, 4\)"):
        hio.correct([room_map], [EYE, EYE])
    with pytest.raises(ValueError, match="bounds"):
        hio.transform(room_map, EYE, bounds=BOUNDS[0])
