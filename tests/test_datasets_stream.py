"""The bounds of a stream, and frames that cannot be used."""

import numpy as np
import pytest

from hiosdf_jax.datasets import BadFrameError, FrameStream, find_bounds


class Room:
    """A stream from inside a box, with a few impossible returns."""

    low, high = np.array([-3.0, -2.0, 0.0]), np.array([4.0, 2.0, 2.5])

    def __init__(self, strays=0, frames=4, points=8000):
        rng = np.random.default_rng(0)
        self.frames = []
        for i in range(frames):
            walls = rng.uniform(self.low, self.high, (points, 3))
            axis, side = rng.integers(0, 3, points), rng.integers(0, 2, points)
            walls[np.arange(points), axis] = np.where(side, self.high[axis], self.low[axis])
            if strays:
                walls[:strays] = rng.uniform(20, 500, (strays, 3)) * rng.choice([-1, 1], 3)
            angle = 0.3 + i
            pose = np.eye(4, dtype=np.float32)
            pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            pose[:3, 3] = [i / 10, 0, 1]
            cloud = (walls - pose[:3, 3]) @ pose[:3, :3]
            cloud[-5:] = np.nan
            self.frames.append((cloud.astype(np.float32), pose))

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


def test_stamps_of_a_stream():
    room = Room()
    assert FrameStream("room", 4, room.__getitem__).stamps is None
    stream = FrameStream("room", 4, room.__getitem__, [0, 0.5, 1, 2])
    np.testing.assert_array_equal(stream.stamps, [0, 0.5, 1, 2])
    with pytest.raises(ValueError, match=r"room: stamps has shape \(3,\), expected \(4,\)"):
        FrameStream("room", 4, room.__getitem__, [0, 0.5, 1])


def test_bounds_of_a_room():
    extent = find_bounds(Room(), margin=0.25)
    np.testing.assert_allclose(extent.bounds[0], Room.low - 0.25, atol=1e-3)
    np.testing.assert_allclose(extent.bounds[1], Room.high + 0.25, atol=1e-3)
    assert all(type(value) is float for corner in extent.bounds for value in corner)
    farthest = max(np.nanmax(np.linalg.norm(cloud, axis=-1)) for cloud, _ in Room())
    assert farthest - 0.2 < extent.max_range <= farthest


def test_stray_returns_do_not_enlarge_the_bounds():
    clean, strayed = find_bounds(Room()), find_bounds(Room(strays=6))
    np.testing.assert_allclose(strayed.bounds, clean.bounds, atol=0.01)


def test_a_single_sparse_scan_has_bounds():
    extent = find_bounds(Room(frames=1, points=150), margin=0)
    np.testing.assert_allclose(extent.bounds[0], Room.low, atol=0.05)
    np.testing.assert_allclose(extent.bounds[1], Room.high, atol=0.05)


def test_a_side_room_observed_briefly_is_kept():
    room = Room(frames=30)
    cloud, pose = room.frames[7]
    beyond = np.random.default_rng(1).uniform([6, 0, 0], [6.4, 0.4, 0.4], (60, 3))
    cloud[:60] = (beyond - pose[:3, 3]) @ pose[:3, :3]  # 0.025 % of all returns
    assert 6.3 < find_bounds(room, margin=0).bounds[1][0] < 6.41


def test_the_bounds_contain_the_path():
    room = Room()
    for i, (_, pose) in enumerate(room.frames):
        pose[2, 3] += 10 * i  # above everything observed
        cloud = room.frames[i][0]
        room.frames[i] = (cloud[cloud[:, 2] < 0], pose)  # it looks down
    bounds = find_bounds(room, margin=0.1).bounds
    assert bounds[1][2] == pytest.approx(31.1)


def test_bad_frames_are_skipped_or_raise():
    room = Room()
    expected = find_bounds(room)
    bad = np.eye(4, dtype=np.float32)
    bad[:3, :3] *= 50
    room.frames += [
        (np.full((5, 3), np.nan, np.float32), room.frames[0][1]),
        (room.frames[0][0], np.full((4, 4), np.nan, np.float32)),
        (room.frames[0][0], bad),
        (np.empty((0, 3), np.float32), room.frames[0][1]),
    ]
    assert find_bounds(room, skip_bad_frames=True) == expected
    with pytest.raises(BadFrameError, match=r"^frame 4: cloud has no finite row among its 5"):
        find_bounds(room)
    room.frames = room.frames[-4:]
    with pytest.raises(ValueError, match="none of the 4 frames"):
        find_bounds(room, skip_bad_frames=True)


@pytest.mark.parametrize("margin", [-1, "a", None, np.nan, np.inf, [0.1, 0.2]])
def test_a_margin_is_a_number(margin):
    with pytest.raises(ValueError, match=r"^margin "):
        find_bounds(Room(), margin=margin)


def test_a_stray_pose_does_not_enlarge_the_bounds():
    room, expected = Room(frames=8), find_bounds(Room(frames=8))
    for stray in (0, 3, 7):
        cloud, pose = room.frames[stray]
        room.frames[stray] = cloud, pose + 9e4 * np.eye(4, k=3, dtype=np.float32)
        with pytest.warns(UserWarning, match=f"frame {stray} at .* is far from the frames before"):
            np.testing.assert_allclose(find_bounds(room).bounds, expected.bounds, atol=0.2)
        room.frames[stray] = cloud, pose
    room.frames[3][1][0, 3] = 1e8
    with pytest.raises(BadFrameError, match=r"^frame 3: pose is 1e\+05 km from the origin"):
        find_bounds(room)


def test_a_fast_sensor_has_no_stray_poses():
    room = Room(frames=8)
    for i, (_, pose) in enumerate(room.frames):
        pose[0, 3] = 500 * i
    assert find_bounds(room, margin=0).bounds[1][0] >= 3500


def test_returns_beyond_all_sensors_are_no_returns():
    room = Room()
    expected = find_bounds(room)
    room.frames.append((room.frames[0][0] * np.float32(1e27), room.frames[0][1]))
    with pytest.raises(BadFrameError, match=r"frame 4: none of its returns is nearer than 100 km"):
        find_bounds(room)
    assert find_bounds(room, skip_bad_frames=True) == expected
