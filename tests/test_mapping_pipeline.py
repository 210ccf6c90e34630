"""The contract of the whole map: purity, transformations, bad input and growth."""

import dataclasses
import functools
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import (
    BOUNDS,
    CONFIG,
    HALF,
    LARGER_BOUNDS,
    arrays_equal,
    ask,
    check_snapshot_outlives_its_map,
    distances,
    room_cloud,
    room_sdf,
    stream,
)

import hiosdf_jax as hio
from hiosdf_jax._src.grid import geometry
from hiosdf_jax._src.mapping import pipeline


def test_the_map_learns_the_room(sharp_map):
    """All stages together: a box has an exact SDF."""
    points = np.random.default_rng(1).uniform(-0.95, 0.95, (2000, 3)) * HALF
    gaps, exact = HALF - np.abs(points), room_sdf(points)
    answer = hio.query(sharp_map, points)
    assert np.abs(np.asarray(answer.sdf) - exact).mean() < 0.02
    assert np.asarray(answer.observed).mean() > 0.98
    slack = exact - np.asarray(answer.lower)
    assert np.mean(slack >= 0) >= 0.99
    assert slack.mean() < 0.04
    # Near one wall and far from the others the gradient is that wall's normal.
    sure = (exact < 0.15) & (np.sort(gaps, axis=1)[:, 1] > 0.3)
    wall = np.argmin(gaps[sure], axis=1)
    normal = -np.sign(points[sure]) * (np.arange(3) == wall[:, None])
    assert sure.sum() > 50
    assert np.mean(np.sum(np.asarray(answer.grad)[sure] * normal, axis=1)) > 0.9
    outside = ask(sharp_map, [[9.0, 0, 0], [0, 0, -7.0]])
    assert not np.asarray(outside.observed).any()


def test_update_is_pure(empty_map):
    cloud, pose = stream(1)[0]
    before = jax.tree.map(jnp.copy, empty_map)
    first = hio.update(empty_map, cloud, pose)
    again = hio.update(empty_map, cloud, pose)
    assert arrays_equal(first, again)
    assert arrays_equal(before, empty_map)
    assert not arrays_equal(first.grid, empty_map.grid)


def test_no_leaf_is_weakly_typed(empty_map, room_map):
    """A weakly typed leaf would compile `update` twice."""
    for state in (empty_map, room_map):
        assert not [leaf for leaf in jax.tree.leaves(state) if getattr(leaf, "weak_type", False)]


def test_one_compilation_for_clouds_of_any_size(empty_map, room_map):
    """Mapping `room_map` compiled `update` for 250 points."""
    state, before = empty_map, pipeline._update_jit._cache_size()
    for count in (1, 40, 299, 300, 301, 900):
        state = hio.update(state, *room_cloud(count, count))
    assert pipeline._update_jit._cache_size() == before
    assert int(state.updates) == 6
    assert int(state.report.points_used) == 300


def test_invalid_rows_change_nothing(empty_map):
    cloud, pose = stream(1)[0]
    rows = np.full((300, 3), np.nan, np.float32)
    rows[:250] = cloud
    rows[260] = [np.inf, 0, 0]
    rows[270] = [0, -np.inf, np.nan]
    a, b = hio.update(empty_map, cloud, pose), hio.update(empty_map, rows, pose)
    assert arrays_equal(a.grid, b.grid)
    assert arrays_equal(a.network, b.network)
    assert int(b.report.points_invalid) == 50


BAD = {
    "empty cloud": (np.zeros((0, 3)), np.eye(4), "cloud has no finite row among its 0"),
    "NaN cloud": (np.full((7, 3), np.nan), np.eye(4), "cloud has no finite row among its 7"),
    "NaN pose": (np.ones((2, 3)), np.full((4, 4), np.nan), "pose has values that are not finite"),
    "scaled pose": (np.ones((2, 3)), np.diag([2.0, 2, 2, 1]), "pose is not rigid"),
    "mirrored pose": (np.ones((2, 3)), np.diag([-1.0, 1, 1, 1]), "pose is not rigid"),
    "bad last row": (np.ones((2, 3)), np.diag([1.0, 1, 1, 2]), "pose is not rigid"),
    "flat cloud": (np.ones(6), np.eye(4), r"cloud has shape \(6,\), expected \(N, 3\)"),
    "wide cloud": (np.ones((2, 4)), np.eye(4), r"cloud has shape \(2, 4\), expected \(N, 3\)"),
    "complex cloud": (np.ones((2, 3), complex), np.eye(4), "cloud has dtype complex128, expected"),
    "words": ([["a", "b", "c"]], np.eye(4), "cloud has dtype <U1, expected real numbers"),
    "huge numbers": ([[10**400, 0, 0]], np.eye(4), "cloud has dtype object, expected real"),
    "ragged cloud": ([[1, 2, 3], [4, 5]], np.eye(4), "cloud is not an array"),
    "no pose": (np.ones((2, 3)), None, "pose has dtype object, expected real numbers"),
    "small pose": (np.ones((2, 3)), np.eye(3), r"pose has shape \(3, 3\), expected \(4, 4\)"),
}


@pytest.mark.parametrize("cloud, pose, message", BAD.values(), ids=BAD.keys())
def test_bad_input_raises_and_names_the_argument(room_map, cloud, pose, message):
    before = jax.tree.map(jnp.copy, room_map)
    with pytest.raises(ValueError, match=message):
        hio.update(room_map, cloud, pose)
    assert arrays_equal(before, room_map)


@pytest.mark.parametrize("dtype", [">f4", "f2", "f8", np.longdouble])
def test_numbers_of_every_type_are_taken(empty_map, dtype):
    cloud, pose = stream(1)[0]
    cloud, pose = cloud.astype(np.float16), np.asarray(pose, np.float16)
    plain = hio.update(empty_map, cloud.astype(np.float32), pose.astype(np.float32))
    assert arrays_equal(hio.update(empty_map, cloud.astype(dtype), pose.astype(dtype)), plain)


def test_masked_rows_are_no_returns(empty_map):
    cloud, pose = stream(1)[0]
    masked = np.ma.masked_array(cloud, np.arange(len(cloud))[:, None].repeat(3, 1) >= 100)
    assert arrays_equal(
        hio.update(empty_map, masked, pose).grid, hio.update(empty_map, cloud[:100], pose).grid
    )


def test_points_outside_the_bounds_leave_no_surface_but_clear_their_ray(empty_map):
    cloud = np.array([[3.0, 0.01, 0.01], [0.7, 0.01, 0.01]], np.float32)
    state = hio.update(empty_map, cloud, np.eye(4))
    assert int(state.report.points_outside) == 1
    assert int(state.report.points_used) == 1
    assert hio.Flag(state.report.flags) == hio.Flag.POINTS_OUTSIDE
    assert float(jnp.sum(state.grid.evidence.hits)) == 1
    assert float(state.grid.evidence.passes[-1, 10, 8]) > 0
    # A sensor that is far outside of the box with all its points must not harm the map either.
    pose = np.eye(4)
    pose[0, 3] = 50
    with pytest.warns(UserWarning, match="less than 1 % of its returns in range inside the bounds"):
        far = hio.update(state, cloud, pose)
    assert arrays_equal(far.grid.evidence.hits, state.grid.evidence.hits)
    assert np.isfinite(distances(far, np.zeros((1, 3)))).all()


def test_range_limits_are_counted(empty_map):
    cloud = np.array([[0.01, 0, 0], [5.0, 0.0, 0], [0.5, 0, 0]], np.float32)
    state = hio.update(empty_map, cloud, np.eye(4))
    assert int(state.report.points_out_of_range) == 2
    assert int(state.report.points_used) == 1
    assert float(jnp.sum(state.grid.evidence.hits)) == 1


def test_an_optimizer_that_is_not_finite_is_flagged_and_heals(room_map):
    adam, *rest = room_map.network.optimizer
    spoiled = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.inf), adam.nu)
    network = room_map.network.replace(optimizer=(adam._replace(nu=spoiled), *rest))
    cloud, pose = stream(1)[0]
    flagged = hio.update(room_map.replace(network=network), cloud, pose)
    assert int(flagged.report.update_flags) == hio.Flag.TRAINING_FAILED
    assert int(flagged.updates) == int(room_map.updates) + 1
    assert arrays_equal(flagged.network.params, room_map.network.params)
    assert arrays_equal(flagged.network.average, room_map.network.average)
    healed = hio.update(flagged, cloud, pose)
    assert int(healed.report.update_flags) == 0
    assert not arrays_equal(healed.network.params, room_map.network.params)


MOVE = np.array([3.0, -2.0, 1.0], np.float32)  # multiples of 0.1 m; exact in binary


def moved(pose):
    pose = np.array(pose)
    pose[:3, 3] += MOVE
    return pose


@pytest.fixture(scope="module")
def moved_map():
    """The map of the same stream in a box moved by whole voxels, which takes all clouds.

    Two tests share it: a configuration of its own compiles `update` anew.
    """
    bounds = tuple(tuple(np.add(corner, MOVE)) for corner in BOUNDS)
    config = dataclasses.replace(CONFIG, bounds=bounds, min_in_range=0.0)
    state = hio.init(config, jax.random.key(0))
    for cloud, pose in stream():
        state = hio.update(state, cloud, moved(pose))
    return state


def test_equivariance_to_moves_by_whole_voxels(room_map, moved_map):
    """The same stream in a box moved by whole voxels gives the same map, moved."""
    hits = moved_map.grid.evidence.hits
    assert np.mean(np.asarray(hits != room_map.grid.evidence.hits)) < 0.01
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (2000, 3)).astype(np.float32)
    difference = hio.sdf(moved_map, points + MOVE) - hio.sdf(room_map, points)
    assert float(jnp.mean(jnp.abs(difference))) < 0.02


def test_snapshot_is_independent_of_a_donated_map(empty_map):
    def donate(state, cloud, pose):
        hio.update(state, cloud, pose, donate=True)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state))

    check_snapshot_outlives_its_map(empty_map, donate)


def test_grow_keeps_every_value(room_map):
    grown = hio.grow(room_map, LARGER_BOUNDS)
    points = np.random.default_rng(3).uniform(*BOUNDS, (2000, 3)).astype(np.float32)
    assert arrays_equal(hio.query(grown, points), hio.query(room_map, points))
    assert grown.config.grid_shape == (33, 40, 23)
    # The two share no memory: either can be donated.
    donated = hio.update(room_map, *stream(1)[0])
    beside = hio.grow(donated, LARGER_BOUNDS)
    hio.update(donated, *stream(1)[0], donate=True)
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(beside))
    # Mapping continues in the new part.
    pose = np.eye(4)
    pose[:3, 3] = [0, 2.0, 0]
    for _ in range(3):
        grown = hio.update(grown, np.array([[0.05, 0.55, 0.05]]), pose)
    beyond = [[0.0, 2.3, 0.0], [0.0, 2.9, 0.0]]
    assert ask(grown, beyond).observed.tolist() == [True, False]
    with pytest.raises(ValueError, match=r"bounds is .*, expected a box that contains"):
        hio.grow(room_map, ((-1, -1, -1), (3, 3, 3)))


def test_a_grown_map_equals_one_of_that_size(empty_map):
    """Distances across the old border are those of a map that had the larger box from the start."""
    once = hio.init(dataclasses.replace(CONFIG, bounds=LARGER_BOUNDS), jax.random.key(0))
    grown = hio.grow(empty_map, LARGER_BOUNDS)
    for cloud, pose in stream(2):
        once, grown = hio.update(once, cloud, pose), hio.update(grown, cloud, pose)
    assert arrays_equal(once.grid, grown.grid)


def test_init_and_queries_name_wrong_arguments(room_map):
    with pytest.raises(ValueError, match="config is dict"):
        hio.init({}, jax.random.key(0))
    with pytest.raises(ValueError, match="key has dtype"):
        hio.init(CONFIG, 0)
    with pytest.raises(ValueError, match="state is NoneType"):
        hio.update(None, np.ones((1, 3)), np.eye(4))
    with pytest.raises(ValueError, match=r"points has shape \(2,\), expected \(..., 3\)"):
        hio.sdf(room_map, np.zeros(2))
    with pytest.raises(ValueError, match=r"\(3, 5\), expected \(..., 3\); is it transposed\?"):
        hio.sdf(room_map, np.zeros((3, 5)))
    with pytest.raises(ValueError, match="field is ndarray, expected a MapState, a Field or a"):
        hio.sdf(np.zeros((5, 3)), room_map)
    with pytest.raises(ValueError, match="field is int"):
        hio.query(3, np.zeros(3))
    with pytest.raises(ValueError, match="state is int"):
        hio.save("nowhere", 3)
    for stamp in (np.nan, jnp.float32(np.nan), jnp.inf, jnp.zeros(2), True, "now"):
        with pytest.raises(ValueError, match="stamp"):
            hio.snapshot(room_map, stamp)
    assert float(jax.jit(hio.snapshot)(room_map, 1.5).stamp) == 1.5
    assert float(jax.jit(lambda state: hio.snapshot(state, 1.5))(room_map).stamp) == 1.5
    old_style = hio.init(CONFIG, jax.random.PRNGKey(0))
    assert arrays_equal(old_style, hio.init(CONFIG, jax.random.key(0)))


@pytest.mark.parametrize(
    "flags, names",
    [
        (0, "none"),
        (2, "EMPTY_CLOUD"),
        (48, "OUT_OF_RANGE|INCONSISTENT_CLOUD"),
        (1 + 2**20, "BAD_POSE|1048576"),  # a flag of a later version
    ],
)
def test_flags_print_their_names(flags, names):
    flags = hio.Flag(flags)
    assert str(flags) == f"{flags}" == names
    assert f"{flags:>40}" == names.rjust(40)
    assert (hio.Flag.OUT_OF_RANGE in flags) == ("OUT_OF_RANGE" in names)


@pytest.mark.parametrize("kind", [jnp.uint32, np.uint32, np.array])
@pytest.mark.parametrize("bits", [0, 2, 48, 1 + 2**20])
def test_flags_are_made_of_the_array_in_a_report(kind, bits):
    array = kind(bits)
    with jax.transfer_guard("disallow"):
        assert hio.Flag(array) is hio.Flag(bits)


def test_flags_of_a_stack_are_refused():
    with pytest.raises(ValueError, match=r"flags has shape \(2,\), expected \(\)"):
        hio.Flag(jnp.array([1, 2], jnp.uint32))


@pytest.mark.parametrize("value", [2.5, np.float32(2.5), "2", None])
def test_flags_of_no_integer_are_refused(value):
    with pytest.raises(ValueError, match=r"flags is .*, expected an integer, as in a report"):
        hio.Flag(value)


OUT_OF_RANGE = {"far": np.full((50, 3), 30.0), "near": np.zeros((4, 3))}


@pytest.mark.parametrize("cloud", OUT_OF_RANGE.values(), ids=OUT_OF_RANGE.keys())
def test_a_cloud_out_of_range_changes_nothing_but_the_flags(room_map, cloud):
    with pytest.warns(UserWarning, match=f"cloud has 0 of {len(cloud)} returns between") as caught:
        after = hio.update(room_map, cloud, np.eye(4))
    assert caught[0].filename == __file__  # where the caller is
    flag = jnp.uint32(hio.Flag.OUT_OF_RANGE)
    report = room_map.report.replace(update_flags=flag, flags=room_map.report.flags | flag)
    assert arrays_equal(after, room_map.replace(report=report))


def test_a_cloud_out_of_range_clears_space_and_trains_if_none_need_be_in_range(moved_map):
    """Its rays clear space, and no flag is raised."""
    state = moved_map
    index, _, _ = geometry.voxel_of(state.config, jnp.asarray([MOVE + 0.3]))
    at = tuple(np.asarray(index)[0])
    for name, cloud in OUT_OF_RANGE.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            after = hio.update(state, cloud, moved(np.eye(4)))
        assert int(after.report.flags) == int(after.report.update_flags) == 0
        assert np.isfinite(float(after.report.sdf_loss))
        assert int(after.updates) == int(state.updates) + 1
        assert not arrays_equal(after.network.params, state.network.params)
        clears = float(after.grid.evidence.passes[at]) > float(state.grid.evidence.passes[at])
        assert clears == (name == "far")


def test_a_fresh_state_can_be_donated():
    state = hio.init(CONFIG, jax.random.key(5))
    after = hio.update(state, *stream(1)[0], donate=True)
    assert int(after.updates) == 1


def test_donated_maps_equal_kept_ones(room_map, tmp_path):
    path = tmp_path / "map.npz"
    hio.save(path, room_map)
    donated, kept = hio.load(path), room_map
    baked = hio.bake(donated, 0.2)
    for cloud, pose in stream(3):
        before, donated = donated, hio.update(donated, cloud, pose, donate=True)
        kept = hio.update(kept, cloud, pose)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(before))
    assert arrays_equal(donated, kept)
    assert int(donated.updates) == int(room_map.updates) + 3
    assert arrays_equal(baked, hio.bake(room_map, 0.2))

    with pytest.raises(ValueError, match="rigid"):
        hio.update(donated, cloud, 2 * np.eye(4), donate=True)
    again = hio.update(donated, cloud, pose, donate=True)
    assert arrays_equal(again, hio.update(kept, cloud, pose))


def test_donating_has_no_effect_inside_jit(empty_map):
    arguments = (empty_map, *(jnp.asarray(array) for array in stream(1)[0]))
    donating = jax.make_jaxpr(functools.partial(hio.update, donate=True))(*arguments)
    assert str(donating) == str(jax.make_jaxpr(hio.update)(*arguments))


def test_update_with_64_bit_numbers_enabled():
    """Many controllers enable them before they import anything."""
    code = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import dataclasses, numpy as np, hiosdf_jax as hio\n"
        "from hiosdf_jax._src.grid import geometry\n"
        "from hiosdf_jax._src.network import tiles\n"
        "from room import CONFIG, stream\n"
        # Both windows around a cloud, and several tiles of the network's rows.
        "config = dataclasses.replace(CONFIG, bounds=((-9, -1, -1), (9, 1, 1)), batches=1,\n"
        "    max_range=2.0, near_samples=5000, distance_horizon=0.3, frontier_horizon=0.3)\n"
        "count = config.near_samples + config.far_samples\n"
        "assert count > tiles.LARGEST\n"
        "shapes = [geometry.window_shape(config, share * 2.0 + 1.2) for share in (0.5, 1)]\n"
        "assert shapes[0] != shapes[1]\n"
        "state = hio.update(hio.init(config, jax.random.key(0)), *stream(1)[0])\n"
        "assert np.isfinite(hio.sdf_and_grad(state, np.zeros((5, 3)))[1]).all()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent)
