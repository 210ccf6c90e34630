"""The npz reader against a conversion pixel by pixel, and against recorded exact distances."""

import math
from pathlib import Path

import numpy as np
import pytest

from hiosdf_jax.datasets import NpzStream, find_bounds, read_truth

SHARED = Path(__file__).parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="needs ../shared/data")

RNG = np.random.default_rng(0)
POSES = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
POSES[:, :3, 3] = [[0, 0, 1], [0, 0.5, 1], [0, 1, 1]]
DEPTH = {
    "poses": POSES,
    "depth": RNG.integers(0, 4000, (3, 4, 5)).astype(np.uint16),
    "K": np.array([[4.0, 0, 2.1], [0, 5.0, 1.4], [0, 0, 1]]),
    "depth_scale": np.float32(500),
}
DIRECTIONS = RNG.normal(size=(2, 6, 3))
DIRECTIONS = (DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=-1, keepdims=True)).astype(np.float32)
RANGE = {
    "poses": POSES,
    "range": RNG.integers(0, 9000, (3, 2, 6)).astype(np.uint16),
    "directions": DIRECTIONS,
    "range_scale": np.float32(250),
}
POINTS = {
    "poses": POSES,
    "points_mm": RNG.integers(-9000, 9000, (9, 3)).astype(np.int16),
    "offsets": np.array([0, 4, 4, 9]),
}
TRUTH = {
    "eval_visible": RNG.normal(size=(6, 3)),
    "eval_visible_sdf": RNG.uniform(size=6),
    "eval_visible_grad": RNG.normal(size=(6, 3)),
    "eval_visible_frame": np.arange(6),
    "eval_surface": RNG.normal(size=(4, 3)),
}


def write(tmp_path, arrays, **changes):
    path = tmp_path / "stream.npz"
    arrays = arrays | changes
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


@pytest.mark.parametrize("invalid", [None, [0, 65535, 1234]])
def test_depth(tmp_path, invalid):
    depth = DEPTH["depth"].copy()
    depth[1, 2, 3], depth[1, 0, 1], depth[1, 3, 3] = 0, 65535, 1234
    changes = {"depth": depth} | ({} if invalid is None else {"invalid": np.uint16(invalid)})
    stream = NpzStream(write(tmp_path, DEPTH, **changes))
    assert len(stream) == 3
    cloud, pose = stream[1]
    assert cloud.dtype == pose.dtype == np.float32
    assert cloud.shape == (20, 3)
    np.testing.assert_array_equal(pose, POSES[1])
    for v in range(4):
        for u in range(5):
            raw = int(depth[1, v, u])
            if raw == 0 or raw in (invalid or ()):
                assert np.isnan(cloud[5 * v + u]).all()
                continue
            z = raw / 500
            expected = [(u - 2.1) / 4 * z, (v - 1.4) / 5 * z, z]
            np.testing.assert_allclose(cloud[5 * v + u], expected, rtol=1e-5, atol=1e-6)


def test_depth_in_meters_with_nan(tmp_path):
    depth = np.full((3, 4, 5), 1.5, np.float32)
    depth[2, 1, 1], depth[2, 1, 2] = np.nan, np.inf
    stream = NpzStream(write(tmp_path, DEPTH, depth=depth, depth_scale=np.float32(1)))
    cloud, _ = stream[2]
    assert np.isnan(cloud).all(axis=-1).sum() == 2
    np.testing.assert_allclose(cloud[0, 2], 1.5)


def test_range(tmp_path):
    stream = NpzStream(write(tmp_path, RANGE))
    cloud, _ = stream[2]
    assert cloud.shape == (12, 3)
    for i in range(2):
        for j in range(6):
            raw = int(RANGE["range"][2, i, j])
            expected = raw / 250 * DIRECTIONS[i, j] if raw else [np.nan] * 3
            np.testing.assert_allclose(cloud[6 * i + j], expected, rtol=1e-5)


def test_points(tmp_path):
    stream = NpzStream(write(tmp_path, POINTS))
    np.testing.assert_allclose(stream[0][0], POINTS["points_mm"][:4] / 1000, rtol=1e-6)
    assert stream[1][0].shape == (0, 3)  # an empty scan is for the map to refuse
    np.testing.assert_allclose(stream[2][0], POINTS["points_mm"][4:] / 1000, rtol=1e-6)


def test_a_stream_is_a_sequence(tmp_path):
    stream = NpzStream(write(tmp_path, RANGE))
    assert len(list(stream)) == 3
    np.testing.assert_array_equal(stream[-1][0], stream[2][0])
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"frame {index}, expected one of 3"):
            stream[index]
    for index in (slice(1, 3), 1.5):
        with pytest.raises(TypeError, match=r"frame .*, expected a whole number"):
            stream[index]
    stream[0][1][:] = 7  # changing a returned pose does not change the stream
    np.testing.assert_array_equal(stream[0][1], POSES[0])


@pytest.mark.parametrize("arrays", [DEPTH, RANGE, POINTS], ids=lambda each: list(each)[1])
def test_poses_that_are_not_read(tmp_path, arrays):
    with_poses = NpzStream(write(tmp_path, arrays))
    for poses in (None, POSES[:2]):
        stream = NpzStream(write(tmp_path, arrays, poses=poses), poses=False)
        assert len(stream) == 3
        for (cloud, pose), (expected, _) in zip(stream, with_poses, strict=True):
            np.testing.assert_array_equal(cloud, expected)
            np.testing.assert_array_equal(pose, np.eye(4))
            assert pose.dtype == np.float32


def test_times_of_frames(tmp_path):
    assert NpzStream(write(tmp_path, POINTS)).stamps is None
    stamps = 1.7e9 + np.array([0, 0.1, 0.3])
    np.testing.assert_array_equal(NpzStream(write(tmp_path, POINTS, stamp=stamps)).stamps, stamps)
    with pytest.raises(ValueError, match=r"stamp has shape \(2,\), expected \(3,\)"):
        NpzStream(write(tmp_path, POINTS, stamp=stamps[:2]))


def test_a_bad_pose_is_a_bad_frame(tmp_path):
    poses = POSES.copy()
    poses[1, 0, 0] = np.nan
    path = write(tmp_path, RANGE, poses=poses)
    stream = NpzStream(path)
    np.testing.assert_array_equal(stream[0][1], POSES[0])
    with pytest.raises(ValueError, match=r"poses\[1\]: pose has values .* not finite") as error:
        stream[1]
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("arrays", "changes", "message"),
    [
        (DEPTH, {"depth": None}, "has none of the keys"),
        (DEPTH, {"points_mm": POINTS["points_mm"]}, r"has \['depth', 'points_mm'\] of the keys"),
        (DEPTH, {"K": None}, "key 'K' is missing"),
        (DEPTH, {"poses": None}, "has no poses, expected the key 'poses'"),
        (DEPTH, {"depth_scale": None}, "key 'depth_scale' is missing"),
        (DEPTH, {"depth_scale": np.float32(0)}, "depth_scale = 0.0, expected a number > 0"),
        (DEPTH, {"depth_scale": np.ones(3)}, r"depth_scale has shape \(3,\), expected \(\)"),
        (DEPTH, {"K": np.eye(4)}, r"K has shape \(4, 4\), expected \(3, 3\)"),
        (DEPTH, {"K": np.zeros((3, 3))}, "expected focal lengths > 0"),
        (DEPTH, {"K": DEPTH["K"].T}, r"K is \[\[4.*, expected 0, 0, 1 in .*; is it transposed\?"),
        (DEPTH, {"depth": np.ones((3, 4))}, r"depth has shape \(3, 4\), expected \(F, H, W\)"),
        (DEPTH, {"poses": POSES[:2]}, r"poses has shape \(2, 4, 4\), expected \(3, 4, 4\)"),
        (DEPTH, {"poses": POSES[:, :3]}, r"poses has shape \(3, 3, 4\), expected \(3, 4, 4\)"),
        (DEPTH, {"poses": np.array(["a"])}, "poses has type <U1, expected numbers"),
        (DEPTH, {"poses": np.array([None])}, "key 'poses': not a readable array"),
        (RANGE, {"directions": DIRECTIONS[0]}, r"directions has shape \(6, 3\), expected \(2, 6"),
        (RANGE, {"directions": 1.05 * DIRECTIONS}, "directions have length 1.05, expected unit"),
        (RANGE, {"directions": np.nan * DIRECTIONS}, "directions have no finite length"),
        (RANGE, {"range_scale": np.float32("nan")}, "range_scale = nan"),
        (RANGE, {"range": np.ones(3)}, r"range has shape \(3,\)"),
        (POINTS, {"offsets": None}, "key 'offsets' is missing"),
        (POINTS, {"offsets": np.array([0, 4, 9])}, r"poses has shape \(3, 4, 4\), expected \(2,"),
        (POINTS, {"offsets": np.array([0, 4, 4, 8])}, "run from 0 to 8, expected 0 to the 9 rows"),
        (POINTS, {"offsets": np.array([0, 6, 4, 9])}, "offsets of frame 1 run from 6 to 4"),
        (POINTS, {"offsets": np.array([0, 4.5, 9])}, "expected .* integers"),
    ],
)
def test_messages_of_bad_files_name_the_file_and_the_key(tmp_path, arrays, changes, message):
    path = write(tmp_path, arrays, **changes)
    with pytest.raises(ValueError, match=message) as error:
        NpzStream(path)
    assert str(path) in str(error.value)


def test_files_that_are_not_npz(tmp_path):
    with pytest.raises(FileNotFoundError):
        NpzStream(tmp_path / "none.npz")
    text = tmp_path / "text.npz"
    text.write_text("not an archive")
    with pytest.raises(ValueError, match="not a readable npz file"):
        NpzStream(text)
    single = tmp_path / "single.npy"
    np.save(single, np.ones(3))
    with pytest.raises(ValueError, match="holds a single array"):
        NpzStream(single)
    cut = write(tmp_path, DEPTH)
    cut.write_bytes(cut.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"stream\.npz"):
        NpzStream(cut)


def test_truth(tmp_path):
    assert read_truth(write(tmp_path, DEPTH)) is None
    truth = read_truth(write(tmp_path, DEPTH | TRUTH))
    for value, key in zip(truth[:5], TRUTH, strict=True):
        np.testing.assert_allclose(value, TRUTH[key], rtol=1e-6)
    assert truth.thin_points_world.shape == (0, 3)  # npz files do not mark thin parts
    assert truth.points_world.dtype == np.float32
    assert truth.frame.dtype == np.int32
    with pytest.raises(ValueError, match="key 'eval_visible_grad' is missing"):
        read_truth(write(tmp_path, DEPTH | TRUTH, eval_visible_grad=None))
    with pytest.raises(ValueError, match=r"eval_visible_sdf has shape \(5,\), expected \(6,\)"):
        read_truth(write(tmp_path, DEPTH | TRUTH, eval_visible_sdf=np.ones(5)))


@needs_shared
@pytest.mark.parametrize(
    ("name", "frames", "points"),
    [
        ("house_depth", 120, 76800),
        ("house_lidar", 80, 16384),
        ("kitchen_depth", 100, 307200),
        ("hall_lidar", 89, 19968),
    ],
)
def test_recorded_streams(name, frames, points):
    stream = NpzStream(SHARED / f"{name}.npz")
    assert len(stream) == frames
    cloud, pose = stream[3]
    assert cloud.shape == (points, 3)
    assert cloud.dtype == pose.dtype == np.float32
    assert np.isfinite(cloud).all(axis=-1).mean() > 0.5
    assert math.isclose(np.linalg.det(pose[:3, :3]), 1, abs_tol=1e-3)
    has_truth = read_truth(SHARED / f"{name}.npz") is not None
    assert has_truth == name.startswith("house")


@needs_shared
@pytest.mark.parametrize("name", ["house_depth", "house_lidar"])
def test_recorded_clouds_lie_on_the_exact_surface(name):
    from scipy.spatial import cKDTree

    path = SHARED / f"{name}.npz"
    stream, truth = NpzStream(path), read_truth(path)
    clouds = []
    for i in range(0, len(stream), 4):
        cloud, pose = stream[i]
        clouds.append(cloud[::7] @ pose[:3, :3].T + pose[:3, 3])
    cloud = np.concatenate(clouds)
    cloud = cloud[np.isfinite(cloud).all(axis=-1)]
    # Neighboring returns are some centimeters apart; a wrong convention is meters off.
    assert np.median(cKDTree(cloud).query(truth.surface_points_world[::20])[0]) < 0.06
    (low, high), _ = find_bounds(stream)
    for points in (truth.points_world, truth.surface_points_world):
        assert ((points > low) & (points < high)).all()


def test_a_frame_of_points_has_a_limit_too(tmp_path):
    many = {
        "points_mm": np.zeros((2_100_000, 3), np.int16),
        "offsets": np.array([0, 1, 2, 2_100_000]),
    }
    path = tmp_path / "stream.npz"
    np.savez_compressed(path, **(POINTS | many))
    with pytest.raises(ValueError, match="points_mm has 2099998 returns in a frame, expected at"):
        NpzStream(path)
