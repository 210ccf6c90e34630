"""The contract of the whole map: purity, transformations, bad input, growth, persistence."""

import dataclasses
import functools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import BOUNDS, CONFIG, HALF, room_cloud, room_sdf, stream

import hiosdf_jax as hio
from hiosdf_jax._src.grid import evidence, geometry, patches
from hiosdf_jax._src.mapping import intake, pipeline


def arrays_equal(a, b):
    def plain(tree):
        return [
            np.asarray(
                jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
            )
            for x in jax.tree.leaves(tree)
        ]

    return all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(plain(a), plain(b), strict=True)
    )


def closeness(a, b):
    """Largest difference between two maps' answers, m."""
    points = np.random.default_rng(0).uniform(BOUNDS[0], BOUNDS[1], (500, 3)).astype(np.float32)
    return float(jnp.max(jnp.abs(hio.sdf(a, points) - hio.sdf(b, points))))


@pytest.fixture(scope="module")
def empty():
    return hio.init(CONFIG, jax.random.key(0))


@pytest.fixture(scope="module")
def mapped(empty):
    state = empty
    for cloud, pose in stream():
        state = hio.update(state, cloud, pose)
    return state


def test_the_map_learns_the_room():
    """All stages together, at a size that can learn: a box has an exact SDF."""
    config = dataclasses.replace(
        CONFIG, near_samples=2000, far_samples=4000, hidden_width=64, epochs=20, max_points=2000
    )
    state = hio.init(config, jax.random.key(0))
    for cloud, pose in stream(12, 2000):
        state = hio.update(state, cloud, pose)
    points = np.random.default_rng(1).uniform(-0.95, 0.95, (2000, 3)) * HALF
    gaps, exact = HALF - np.abs(points), room_sdf(points)
    answer = hio.query(state, points)
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
    outside = hio.query(state, np.array([[9.0, 0, 0], [0, 0, -7.0]]))
    assert not np.asarray(outside.observed).any()


def test_update_is_pure(empty):
    cloud, pose = stream(1)[0]
    before = jax.tree.map(jnp.copy, empty)
    first = hio.update(empty, cloud, pose)
    again = hio.update(empty, cloud, pose)
    assert arrays_equal(first, again)
    assert arrays_equal(before, empty)
    assert not arrays_equal(first.grid, empty.grid)


def test_no_leaf_is_weakly_typed(empty, mapped):
    """A weakly typed leaf would compile `update` twice."""
    for state in (empty, mapped):
        assert not [leaf for leaf in jax.tree.leaves(state) if getattr(leaf, "weak_type", False)]


def test_one_compilation_for_clouds_of_any_size():
    config = dataclasses.replace(CONFIG, hidden_width=8)
    state = hio.init(config, jax.random.key(0))
    before = pipeline._update_jit._cache_size()
    for count in (1, 40, 299, 300, 301, 900):
        state = hio.update(state, *room_cloud(count, count))
    assert pipeline._update_jit._cache_size() == before + 1
    assert int(state.updates) == 6
    assert int(state.report.points_used) == 300


def test_scan_and_user_jit_equal_the_eager_loop(empty, mapped):
    clouds, poses = (jnp.stack(part) for part in zip(*stream(), strict=True))

    @jax.jit
    def scanned(state, clouds, poses):
        return jax.lax.scan(lambda s, x: (hio.update(s, *x), s.report), state, (clouds, poses))

    last, reports = scanned(empty, clouds, poses)
    # The cloud is not padded inside jit (250 rows, not 300): the result must not depend on that.
    assert arrays_equal(last.grid.evidence.hits, mapped.grid.evidence.hits)
    assert closeness(last, mapped) < 1e-5
    assert int(last.updates) == 4
    assert reports.points_used.shape == (4,)

    @jax.jit
    def planner(state, cloud, pose, points):
        return hio.sdf_and_grad(hio.update(state, cloud, pose), points)

    cloud, pose = stream(1)[0]
    points = jnp.zeros((5, 3))
    value, gradient = planner(empty, cloud, pose, points)
    expected = hio.sdf_and_grad(hio.update(empty, cloud, pose), points)
    np.testing.assert_allclose(value, expected[0], atol=1e-5)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-4)


def test_vmap_over_two_maps_equals_each(empty):
    other = hio.init(CONFIG, jax.random.key(1))
    frames = stream(2)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), empty, other)
    clouds, poses = (jnp.stack(part) for part in zip(*frames, strict=True))
    together = jax.jit(jax.vmap(hio.update))(both, clouds, poses)
    for k, state in enumerate((empty, other)):
        alone = hio.update(state, *frames[k])
        part = jax.tree.map(lambda leaf, k=k: leaf[k], together)
        assert arrays_equal(part.grid.evidence.hits, alone.grid.evidence.hits)
        assert arrays_equal(part.grid.evidence.passes, alone.grid.evidence.passes)
        assert closeness(part, alone) < 1e-4


def test_invalid_rows_change_nothing(empty):
    cloud, pose = stream(1)[0]
    rows = np.full((300, 3), np.nan, np.float32)
    rows[:250] = cloud
    rows[260] = [np.inf, 0, 0]
    rows[270] = [0, -np.inf, np.nan]
    a, b = hio.update(empty, cloud, pose), hio.update(empty, rows, pose)
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
    "small pose": (np.ones((2, 3)), np.eye(3), r"pose has shape \(3, 3\), expected \(4, 4\)"),
}


@pytest.mark.parametrize("cloud, pose, message", BAD.values(), ids=BAD.keys())
def test_bad_input_raises_and_names_the_argument(mapped, cloud, pose, message):
    before = jax.tree.map(jnp.copy, mapped)
    with pytest.raises(ValueError, match=message):
        hio.update(mapped, cloud, pose)
    assert arrays_equal(before, mapped)


@pytest.mark.parametrize(
    "cloud, pose, flag",
    [
        (np.full((5, 3), np.nan), np.eye(4), hio.Flag.EMPTY_CLOUD),
        (np.ones((5, 3)), np.full((4, 4), np.nan), hio.Flag.BAD_POSE),
        (np.ones((5, 3)), np.diag([2.0, 2, 2, 1]), hio.Flag.BAD_POSE),
        (
            np.full((5, 3), np.nan),
            np.diag([2.0, 2, 2, 1]),
            hio.Flag.BAD_POSE | hio.Flag.EMPTY_CLOUD,
        ),
    ],
)
def test_bad_input_inside_jit_only_raises_a_sticky_flag(mapped, cloud, pose, flag):
    after = jax.jit(hio.update)(mapped, jnp.asarray(cloud), jnp.asarray(pose))
    assert hio.Flag(int(after.report.flags)) == flag
    flags = mapped.report.flags
    assert arrays_equal(after.replace(report=after.report.replace(flags=flags)), mapped)
    later = hio.update(after, *stream(1)[0])
    assert hio.Flag(int(later.report.flags)) == flag


def test_points_outside_the_bounds_leave_no_surface_but_clear_their_ray(empty):
    cloud = np.array([[3.0, 0.01, 0.01], [0.7, 0.01, 0.01]], np.float32)
    state = hio.update(empty, cloud, np.eye(4))
    assert int(state.report.points_outside) == 1
    assert int(state.report.points_used) == 1
    assert hio.Flag(int(state.report.flags)) == hio.Flag.POINTS_OUTSIDE
    assert float(jnp.sum(state.grid.evidence.hits)) == 1
    assert float(state.grid.evidence.passes[-1, 10, 8]) > 0
    # A sensor that is far outside of the box with all its points must not harm the map either.
    pose = np.eye(4)
    pose[0, 3] = 50
    far = hio.update(state, cloud, pose)
    assert arrays_equal(far.grid.evidence.hits, state.grid.evidence.hits)
    assert np.isfinite(np.asarray(hio.sdf(far, np.zeros((1, 3))))).all()


def test_range_limits_are_counted(empty):
    cloud = np.array([[0.01, 0, 0], [5.0, 0.0, 0], [0.5, 0, 0]], np.float32)
    state = hio.update(empty, cloud, np.eye(4))
    assert int(state.report.points_out_of_range) == 2
    assert int(state.report.points_used) == 1
    assert float(jnp.sum(state.grid.evidence.hits)) == 1


def test_equivariance_to_moves_by_whole_voxels(mapped):
    """The same stream in a box moved by whole voxels gives the same map, moved."""
    move = np.array([3.0, -2.0, 1.0], np.float32)  # multiples of 0.1 m; exact in binary
    moved = dataclasses.replace(
        CONFIG, bounds=tuple(tuple(np.add(corner, move)) for corner in BOUNDS)
    )
    state = hio.init(moved, jax.random.key(0))
    for cloud, pose in stream():
        pose = pose.copy()
        pose[:3, 3] += move
        state = hio.update(state, cloud, pose)
    assert np.mean(np.asarray(state.grid.evidence.hits != mapped.grid.evidence.hits)) < 0.01
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (200, 3)).astype(np.float32)
    difference = hio.sdf(state, points + move) - hio.sdf(mapped, points)
    assert float(jnp.mean(jnp.abs(difference))) < 0.02


def test_snapshot_is_independent_of_a_donated_map(empty):
    state = hio.update(empty, *stream(1)[0])
    field = hio.snapshot(state)
    points = np.zeros((3, 3))
    before = hio.query(field, points)
    assert arrays_equal(before, hio.query(state, points))
    jax.jit(hio.update, donate_argnums=0)(state, *(jnp.asarray(x) for x in stream(1)[0]))
    assert arrays_equal(hio.query(field, points), before)
    assert int(field.updates) == 1


def test_grow_keeps_every_value(mapped):
    larger = ((-2.05, -1.0, -1.5), (1.2, 3.0, 0.8))
    grown = hio.grow(mapped, larger)
    points = np.random.default_rng(3).uniform(*BOUNDS, (400, 3)).astype(np.float32)
    assert arrays_equal(hio.query(grown, points), hio.query(mapped, points))
    assert grown.config.grid_shape == (33, 40, 23)
    # The two share no memory: either can be donated.
    donated = hio.update(mapped, *stream(1)[0])
    beside = hio.grow(donated, larger)
    hio.update(donated, *stream(1)[0], donate=True)
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(beside))
    # Mapping goes on in the new part.
    pose = np.eye(4)
    pose[:3, 3] = [0, 2.0, 0]
    for _ in range(3):
        grown = hio.update(grown, np.array([[0.05, 0.55, 0.05]]), pose)
    beyond = hio.query(grown, np.array([[0.0, 2.3, 0.0], [0.0, 2.9, 0.0]]))
    assert np.asarray(beyond.observed).tolist() == [True, False]
    with pytest.raises(ValueError, match=r"bounds is .*, expected a box that contains"):
        hio.grow(mapped, ((-1, -1, -1), (3, 3, 3)))


def test_a_grown_map_is_as_good_as_one_of_that_size(empty):
    """Distances across the old border are those of a map that had the larger box at once."""
    larger = ((-1.2, -1.0, -0.8), (2.4, 1.0, 0.8))
    once = hio.init(dataclasses.replace(CONFIG, bounds=larger), jax.random.key(0))
    grown = hio.grow(empty, larger)
    for cloud, pose in stream(2):
        once, grown = hio.update(once, cloud, pose), hio.update(grown, cloud, pose)
    assert arrays_equal(once.grid, grown.grid)


def test_save_load_and_go_on_is_bit_identical(mapped, tmp_path):
    path = tmp_path / "map.npz"
    hio.save(path, mapped)
    loaded = hio.load(path)
    assert loaded.config == mapped.config
    assert arrays_equal(loaded, mapped)
    frame = stream(6)[5]
    assert arrays_equal(hio.update(loaded, *frame), hio.update(mapped, *frame))
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


def test_a_saved_file_has_the_rights_of_any_other(mapped, tmp_path):
    hio.save(tmp_path / "map.npz", mapped)
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "map.npz").stat().st_mode == (tmp_path / "other").stat().st_mode
    assert {path.name for path in tmp_path.iterdir()} == {"map.npz", "other"}


def test_a_failed_save_keeps_the_old_file(mapped, tmp_path, monkeypatch):
    path = tmp_path / "map.npz"
    hio.save(path, mapped)
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        hio.save(path, mapped)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


def test_load_names_what_is_wrong(mapped, tmp_path):
    with pytest.raises(FileNotFoundError):
        hio.load(tmp_path / "none.npz")
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(ValueError, match=r"broken.npz is not a readable"):
        hio.load(broken)
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"\x89PNG and no archive")
    with pytest.raises(ValueError, match=r"picture.png is not a readable .npz file: it is none$"):
        hio.load(picture)
    with pytest.raises(FileNotFoundError, match=r"no such folder.*nowhere'"):
        hio.save(tmp_path / "nowhere" / "map", mapped)
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, a=np.zeros(3))
    with pytest.raises(ValueError, match=r"foreign.npz is not a hiosdf_jax map"):
        hio.load(foreign)
    path = tmp_path / "map.npz"
    hio.save(path, mapped)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    short = {name: array for name, array in arrays.items() if name != "grid.hits"}
    np.savez(path, **short)
    with pytest.raises(ValueError, match=r"lacks the array grid\.hits"):
        hio.load(path)
    np.savez(path, **(arrays | {"grid.hits": arrays["grid.hits"][1:]}))
    with pytest.raises(ValueError, match=r"has grid\.hits of float16"):
        hio.load(path)
    newer = str(arrays["header"]).replace('"version": 2', '"version": 99')
    np.savez(path, **(arrays | {"header": np.asarray(newer)}))
    with pytest.raises(ValueError, match="format version 99, expected 2"):
        hio.load(path)


def test_init_and_queries_name_wrong_arguments(mapped):
    with pytest.raises(ValueError, match="config is dict"):
        hio.init({}, jax.random.key(0))
    with pytest.raises(ValueError, match="key has dtype"):
        hio.init(CONFIG, 0)
    with pytest.raises(ValueError, match="state is NoneType"):
        hio.update(None, np.ones((1, 3)), np.eye(4))
    with pytest.raises(ValueError, match=r"points has shape \(2,\), expected \(..., 3\)"):
        hio.sdf(mapped, np.zeros(2))
    with pytest.raises(ValueError, match="field is int"):
        hio.query(3, np.zeros(3))
    with pytest.raises(ValueError, match="state is int"):
        hio.save("nowhere", 3)
    old_style = hio.init(CONFIG, jax.random.PRNGKey(0))
    assert arrays_equal(old_style, hio.init(CONFIG, jax.random.key(0)))


def test_a_cloud_out_of_range_still_trains_on_the_grid(mapped):
    """All that is left of it are free rays; nothing is wrong with that."""
    for cloud in (np.full((50, 3), 30.0), np.zeros((4, 3))):
        after = hio.update(mapped, cloud, np.eye(4))
        assert int(after.report.flags) == int(mapped.report.flags)
        assert np.isfinite(float(after.report.sdf_loss))
        assert int(after.updates) == int(mapped.updates) + 1
        assert not arrays_equal(after.network.params, mapped.network.params)
    far = hio.update(mapped, np.full((50, 3), 30.0), np.eye(4))
    index, _, _ = geometry.voxel_of(CONFIG, jnp.asarray([[0.3, 0.3, 0.3]]))
    at = tuple(np.asarray(index)[0])
    assert float(far.grid.evidence.passes[at]) > float(mapped.grid.evidence.passes[at])


def test_an_empty_cloud_inside_jit_is_flagged(mapped):
    after = jax.jit(hio.update)(mapped, jnp.zeros((0, 3)), jnp.eye(4))
    assert int(after.report.flags) & hio.Flag.EMPTY_CLOUD
    assert arrays_equal(after.grid, mapped.grid)


def test_a_fresh_state_can_be_donated():
    state = hio.init(CONFIG, jax.random.key(5))
    after = hio.update(state, *stream(1)[0], donate=True)
    assert int(after.updates) == 1


def test_donated_maps_are_those_of_kept_ones(mapped, tmp_path):
    path = tmp_path / "map.npz"
    hio.save(path, mapped)
    donated, kept = hio.load(path), mapped
    baked = hio.bake(donated, 0.2)
    for cloud, pose in stream(3):
        before, donated = donated, hio.update(donated, cloud, pose, donate=True)
        kept = hio.update(kept, cloud, pose)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(before))
    assert arrays_equal(donated, kept)
    assert int(donated.updates) == int(mapped.updates) + 3
    assert arrays_equal(baked, hio.bake(mapped, 0.2))

    with pytest.raises(ValueError, match="rigid"):
        hio.update(donated, cloud, 2 * np.eye(4), donate=True)
    again = hio.update(donated, cloud, pose, donate=True)
    assert arrays_equal(again, hio.update(kept, cloud, pose))


def test_donating_has_no_effect_inside_jit(empty):
    arguments = (empty, *(jnp.asarray(array) for array in stream(1)[0]))
    donating = jax.make_jaxpr(functools.partial(hio.update, donate=True))(*arguments)
    assert str(donating) == str(jax.make_jaxpr(hio.update)(*arguments))


def test_far_returns_are_averaged_like_near_ones():
    """Their weights are tiny: with this noise 1e-8 at 30 m."""
    config = dataclasses.replace(
        CONFIG, bounds=((28, -1, -1), (31, 1, 1)), max_range=40.0, range_noise=(0.001, 0.01)
    )
    grid, sensor = evidence.empty_grid(config), jnp.zeros(3)
    offsets = np.random.default_rng(0).uniform(-0.04, 0.04, 40)

    @jax.jit
    def fuse(grid, points):
        start, window = evidence.read_evidence(config, grid, sensor)
        window = patches.fuse_hits(config, window, start, points, jnp.ones(1, bool), sensor)
        return evidence.write_evidence(grid, start, window)

    for offset in offsets:
        grid = fuse(grid, jnp.asarray([[30.05 + offset, 0.05, 0.05]], jnp.float32))
    index, _, _ = geometry.voxel_of(config, jnp.asarray([[30.05, 0.05, 0.05]]))
    mean = np.asarray(grid.evidence.mean)[tuple(np.asarray(index)[0])]
    assert abs(0.1 * mean[0] - offsets.mean()) < 1e-3


def at_height(z):
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = z
    return pose


@pytest.mark.parametrize("capacity", [300, 2700])
def test_rows_are_drawn_from_the_whole_cloud(capacity):
    cloud = np.arange(12000, dtype=np.float32).reshape(4000, 3)
    cloud[::4, 1] = np.nan
    drawn, _ = intake.prepare(cloud, at_height(0), capacity)
    assert drawn.shape == (capacity, 3)
    rows = (drawn[:, 0] / 3).astype(int)
    np.testing.assert_array_equal(drawn, cloud[rows])  # no NaN among them
    assert len(np.unique(rows)) == capacity
    other, _ = intake.prepare(cloud, at_height(1), capacity)
    assert not np.array_equal(drawn, other)
    at_rest, _ = intake.prepare(cloud + np.float32([0, 0, 0.5]), at_height(0), capacity)
    assert not np.array_equal(drawn[:, 0], at_rest[:, 0])
    again, _ = intake.prepare(cloud, at_height(0), capacity)
    np.testing.assert_array_equal(drawn, again)


@pytest.mark.parametrize("capacity", [20, 80])
def test_rows_are_drawn_with_equal_chances(capacity):
    cloud = np.arange(300, dtype=np.float32).reshape(100, 3)
    times = np.zeros(100)
    for z in range(4000):
        drawn, _ = intake.prepare(cloud, at_height(z), capacity)
        times[(drawn[:, 0] / 3).astype(int)] += 1
    share = times / 4000
    deviation = np.sqrt(capacity / 100 * (1 - capacity / 100) / 4000)
    assert abs(share - capacity / 100).max() < 5 * deviation


def test_update_with_64_bit_numbers_enabled():
    """Many controllers enable them before they import anything."""
    code = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import dataclasses, numpy as np, hiosdf_jax as hio\n"
        "from hiosdf_jax._src.grid import geometry\n"
        "from hiosdf_jax._src.network import tiles\n"
        "from room import CONFIG, stream\n"
        # Both windows of a change, and several tiles of the network's rows.
        "config = dataclasses.replace(CONFIG, bounds=((-9, -1, -1), (9, 1, 1)), batches=1,\n"
        "    max_range=2.0, near_samples=2000)\n"
        "count = config.near_samples + config.far_samples\n"
        "assert tiles.tile_count(count) > 1\n"
        "shapes = [geometry.window_shape(config, share * 2.0 + 1.9) for share in (0.5, 1)]\n"
        "assert shapes[0] != shapes[1]\n"
        "state = hio.update(hio.init(config, jax.random.key(0)), *stream(1)[0])\n"
        "assert np.isfinite(hio.sdf_and_grad(state, np.zeros((5, 3)))[1]).all()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent)


def test_the_schedule_warms_up_and_never_serves_the_untrained_network():
    config = dataclasses.replace(CONFIG, warmup_updates=3, warmup_epochs=7, epochs=2)
    config = dataclasses.replace(config, weight_average=0.8)
    made = [pipeline.schedule(config, jnp.int32(n)) for n in range(7)]
    assert [int(extra) for extra, _ in made] == [5, 5, 5, 0, 0, 0, 0]
    short = dataclasses.replace(config, warmup_epochs=1)
    assert [int(pipeline.schedule(short, jnp.int32(n))[0]) for n in (2, 3)] == [0, 1]
    expected = [0, 1 / 2, 2 / 3, 3 / 4, 4 / 5, 0.8, 0.8]
    np.testing.assert_allclose([float(average) for _, average in made], expected, atol=1e-6)
