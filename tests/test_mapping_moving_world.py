"""A world that moves, end to end: things come and go, and impossible clouds are refused."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import CONFIG, HALF, arrays_equal, ask, room_cloud

import hiosdf_jax as hio
from hiosdf_jax._src.change import novelty
from hiosdf_jax._src.mapping import stages

# A box that stands in the room for a while, and where the sensor looks at it from.
LOW, HIGH = np.array([0.22, -0.24, -0.23]), np.array([0.57, 0.17, 0.18])
SENSOR = np.array([-0.45, -0.05, 0.02])


def view(seed, with_box):
    """300 exact returns; most of the rays go toward the box, whether it is there or not."""
    rng = np.random.default_rng(seed)
    toward = rng.uniform(LOW - 0.1, HIGH + 0.1, (300, 3)) - SENSOR
    rays = np.where(np.arange(300)[:, None] < 180, toward, rng.normal(size=(300, 3)))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    reach = ((HALF * np.sign(rays) - SENSOR) / rays).min(axis=1)
    if with_box:
        sides = np.stack([(LOW - SENSOR) / rays, (HIGH - SENSOR) / rays])
        entry, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        reach = np.where((entry < leave) & (entry > 0), np.minimum(entry, reach), reach)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = SENSOR
    return (rays * reach[:, None]).astype(np.float32), pose


def inside_box(margin):
    axes = [np.linspace(a + margin, b - margin, 6) for a, b in zip(LOW, HIGH, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def history(sharp_map):
    """The map before the box appears, while it is there, and after it has been taken away."""
    state, maps = sharp_map, {"before": [], "with": [], "after": []}
    for k, (when, with_box) in enumerate((("before", 0), ("with", 1), ("after", 0))):
        for scan in range(5):
            state = hio.update(state, *view(100 * k + scan, with_box))
            maps[when].append(state)
    return maps


def test_a_box_that_appears_is_solid_and_free_again_when_it_is_gone(history):
    points = inside_box(0.06)
    before = ask(history["before"][-1], points, "obstacle")
    assert (before.sdf > 0.1).all() and before.observed.all() and (before.lower > 0).all()
    during = ask(history["with"][-1], points, "obstacle")
    assert (during.sdf < 0).all()
    assert (during.lower < 0).all()
    assert during.observed.mean() < 0.5
    after = ask(history["after"][-1], points, "obstacle")
    assert (after.sdf > 0.1).all() and after.observed.all() and (after.lower > 0).all()
    assert np.abs(after.sdf - before.sdf).mean() < 0.05


def test_the_front_of_a_new_box_is_a_surface_at_once(history):
    """Most of it after the first scan, all of it after some."""
    y, z = np.meshgrid(np.linspace(-0.18, 0.11, 9), np.linspace(-0.17, 0.12, 9))
    front = np.stack([np.full_like(y, LOW[0]), y, z], axis=-1).reshape(-1, 3)
    first = ask(history["with"][0], front, "network").sdf
    last = ask(history["with"][-1], front, "network").sdf
    assert np.mean(np.abs(first) < 0.05) > 0.6
    assert np.abs(last).max() < 0.05
    just_behind = ask(history["with"][0], np.add(front, [0.07, 0, 0]), "obstacle")
    assert np.mean(just_behind.sdf < 0) > 0.9


def test_a_wall_behind_a_box_is_remembered(history):
    """It is hidden from the sensor, counts as unseen, and is there when the box is gone."""
    y, z = np.meshgrid(np.linspace(-0.15, 0.1, 6), np.linspace(-0.15, 0.1, 6))
    wall = np.stack([np.full_like(y, HALF[0]), y, z], axis=-1).reshape(-1, 3)
    at = tuple(np.floor(wall / 0.1 + 1e-9).astype(int).T - np.transpose([CONFIG.corner_index]))
    hits = [
        np.asarray(history[when][-1].grid.evidence.hits)[at] for when in ("before", "with", "after")
    ]
    assert (hits[0] > 2).all() and (hits[1] > 2).all()
    before, during = (history[when][-1] for when in ("before", "with"))
    assert ask(before, wall, "obstacle").observed.all()
    assert ask(during, wall, "obstacle").observed.mean() < 0.3
    for state in (before, *history["after"]):  # from the first scan that sees it again
        assert np.abs(ask(state, wall, "network").sdf).max() < 0.04
    assert ask(history["after"][-1], wall, "obstacle").observed.all()


def test_returns_on_what_is_new_are_counted(history):
    moving = {when: [int(m.report.points_moving) for m in maps] for when, maps in history.items()}
    assert moving["with"][0] > 60
    assert max(moving["with"][2:]) < 30
    assert max(moving["before"] + moving["after"]) < 10
    for maps in history.values():
        assert all(int(state.report.update_flags) == 0 for state in maps)


def contradiction(k=0):
    """A cloud of the room in another unit: nearly all of it is in free space."""
    cloud, pose = room_cloud(k)
    return 0.3 * cloud, pose


@pytest.mark.parametrize("factor", [2.0, 3.28])
def test_a_cloud_that_is_too_long_is_refused_and_not_one_that_is_right(sharp_map, factor):
    """It would clear space through the walls."""
    cloud, pose = room_cloud(55)
    after = hio.update(sharp_map, factor * cloud, pose)
    assert arrays_equal(after, flagged(sharp_map, hio.Flag.INCONSISTENT_CLOUD, refused=1))
    assert int(hio.update(after, cloud, pose).report.update_flags) == 0


def seen_ahead(seed, count=250):
    """Exact returns of a camera that looks along x from behind the middle of the room."""
    rays = np.random.default_rng(seed).uniform(-0.7, 0.7, (count, 3))
    rays[:, 0] = 1
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = -0.4
    reach = ((HALF * np.sign(rays) - pose[:3, 3]) / rays).min(axis=1)
    return (rays * reach[:, None]).astype(np.float32), pose


@pytest.mark.parametrize(
    ("step", "turn"),
    [((0.5, 0, 0), 0), ((0.5, -0.3, 0), 0), ((-0.5, 0.2, 0), 0.3)],
)
def test_a_cloud_at_a_wrong_pose_is_refused_and_the_same_at_the_right_one_is_not(
    sharp_map, step, turn
):
    """Floor, ceiling and some walls still fit: most rays agree with the map."""
    cloud, pose = seen_ahead(1)
    assert int(hio.update(sharp_map, cloud, pose).report.update_flags) == 0
    moved = pose.copy()
    moved[:3, 3] += step
    c, s = np.cos(turn), np.sin(turn)
    moved[:2, :2] = [[c, -s], [s, c]]
    after = hio.update(sharp_map, cloud, moved)
    assert arrays_equal(after, flagged(sharp_map, hio.Flag.INCONSISTENT_CLOUD, refused=1))


def flagged(state, flag, refused=0):
    """The same map with the flags of a cloud that was not fused."""
    report, flag = state.report, jnp.uint32(flag)
    return state.replace(
        report=report.replace(
            refused_in_row=report.refused_in_row + jnp.int32(refused),
            update_flags=flag,
            flags=report.flags | flag,
        )
    )


def test_a_refused_cloud_changes_nothing_but_the_flags(sharp_map):
    after = hio.update(sharp_map, *contradiction())
    assert arrays_equal(after, flagged(sharp_map, hio.Flag.INCONSISTENT_CLOUD, refused=1))
    twice = hio.update(after, *contradiction(1))
    assert arrays_equal(twice, flagged(after, hio.Flag.INCONSISTENT_CLOUD, refused=1))
    # As if it had never come.
    frame = room_cloud(50)
    later, expected = hio.update(twice, *frame), hio.update(sharp_map, *frame)
    assert int(later.report.refused_in_row) == 0
    assert arrays_equal(later.replace(report=expected.report), expected)


def test_a_young_map_refuses_nothing(room_map):
    after = hio.update(room_map, *contradiction())
    assert int(after.updates) == int(room_map.updates) + 1
    assert int(after.report.update_flags) == 0


def test_after_many_refusals_the_next_cloud_is_fused(sharp_map):
    """The sensor may have been carried elsewhere; the map must not stay wrong forever."""
    state = sharp_map
    for k in range(CONFIG.most_refusals):
        state = hio.update(state, *contradiction(k))
        assert int(state.report.refused_in_row) == k + 1
    assert arrays_equal(state.grid, sharp_map.grid)
    state = hio.update(state, *contradiction(99))
    assert int(state.updates) == int(sharp_map.updates) + 1
    assert int(state.report.refused_in_row) == 0
    assert int(state.report.update_flags) == hio.Flag.INCONSISTENT_CLOUD
    assert int(state.report.points_used) == 250
    assert not arrays_equal(state.grid, sharp_map.grid)


def test_other_faults_are_not_counted_as_contradictions(sharp_map):
    """A map waits for a number of clouds that contradict it, not of bad ones."""
    state = hio.update(sharp_map, *contradiction())
    with pytest.warns(UserWarning, match="returns between"):
        far = hio.update(state, np.full((20, 3), 50.0), np.eye(4))
    assert arrays_equal(far, flagged(state, hio.Flag.OUT_OF_RANGE))
    assert int(far.report.refused_in_row) == 1


@jax.jit
def check(state, cloud, pose):
    finite = jnp.ones(len(cloud), bool)
    return stages.run_stages(stages.begin(state, cloud, finite, pose), stages.CHECKS)


@pytest.mark.parametrize(
    ("most", "refused", "accepted"), [(10, 9, False), (10, 10, True), (3, 3, True), (0, 0, True)]
)
def test_the_configuration_says_how_many_clouds_are_refused(sharp_map, most, refused, accepted):
    report = sharp_map.report.replace(refused_in_row=np.int32(refused))
    step = check(sharp_map.replace(report=report), *contradiction())
    config = dataclasses.replace(CONFIG, most_refusals=most)  # after the checks: one compilation
    step = step._replace(state=step.state.replace(config=config))
    assert bool(stages.is_accepted(step)) == accepted
    assert int(step.flags) == hio.Flag.INCONSISTENT_CLOUD


def test_random_points_are_always_refused(sharp_map):
    """A cloud that is no view of any world stays refused, however many came before it."""
    cloud, pose = contradiction()
    for most, refused, noise, accepted in (
        (10, 10, False, True),
        (10, 10, True, False),
        (10, 10_000, True, False),
        (0, 0, True, True),
    ):
        state = sharp_map.replace(
            config=dataclasses.replace(CONFIG, most_refusals=most),
            report=sharp_map.report.replace(refused_in_row=jnp.int32(refused)),
        )
        step = stages.begin(state, jnp.asarray(cloud), jnp.ones(len(cloud), bool), pose)
        found = novelty.Novelty(*5 * [jnp.asarray(False)])._replace(noise=jnp.asarray(noise))
        flags = jnp.uint32(hio.Flag.INCONSISTENT_CLOUD)
        assert bool(stages.is_accepted(step._replace(novelty=found, flags=flags))) == accepted


def test_flags_of_the_last_update_and_of_all(sharp_map):
    cloud, pose = room_cloud(60)
    outside = np.concatenate([cloud, [[2.0, 0.3, 0.3]]])  # in range, beyond the bounds
    none = hio.Flag(0)
    beyond, false = hio.Flag.POINTS_OUTSIDE, hio.Flag.INCONSISTENT_CLOUD
    state = sharp_map
    for frame, last, every in (
        ((cloud, pose), none, none),
        ((outside, pose), beyond, beyond),
        ((cloud, pose), none, beyond),
        (contradiction(), false, beyond | false),
        ((cloud, pose), none, beyond | false),
    ):
        state = hio.update(state, *frame)
        assert hio.Flag(state.report.update_flags) == last
        assert hio.Flag(state.report.flags) == every


@pytest.mark.parametrize("name", ["empty_map", "sharp_map"])
def test_a_cloud_in_millimeters_is_named_and_changes_nothing(name, request):
    state = request.getfixturevalue(name)
    cloud, pose = room_cloud(61)
    with pytest.warns(UserWarning, match="It looks like millimeters, expected m"):
        after = hio.update(state, 1000 * cloud, pose)
    assert arrays_equal(after, flagged(state, hio.Flag.OUT_OF_RANGE))


def test_clouds_in_meters_do_not_warn(empty_map):
    cloud, pose = room_cloud(62)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hio.update(empty_map, cloud, pose)
        # Most returns may be out of range.
        few = np.concatenate([cloud[:10], 100 * cloud[10:]])
        after = hio.update(empty_map, few, pose)
    assert int(after.report.points_used) == 10
    assert not int(after.report.flags) & hio.Flag.OUT_OF_RANGE
    with pytest.warns(UserWarning, match="It looks like centimeters, expected m"):
        hio.update(empty_map, 100 * cloud, pose)
    with pytest.warns(UserWarning, match="Its unit must be m"):
        hio.update(empty_map, 1e5 * cloud, pose)


@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf])
def test_rows_without_a_return_do_not_count_as_out_of_range(empty_map, missing):
    """An organized cloud has a row for each pixel, most of them perhaps without a return."""
    cloud, pose = room_cloud(63)
    rows = np.full((300, 3), missing, np.float32)
    rows[:2] = cloud[:2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        after = hio.update(empty_map, rows, pose)
    assert int(after.report.points_used) == 2
    assert int(after.report.flags) == 0
