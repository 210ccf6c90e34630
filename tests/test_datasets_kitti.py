"""Sequences of the KITTI odometry benchmark."""

import re

import numpy as np
import pytest
from recordings import CLOUDS, IDENTITIES, POSES, check_bad, check_stream, edit_line, write_text

from hiosdf_jax.datasets import BadFrameError, NoPosesError, kitti_stream, open_stream, read_frame


def write_kitti(folder):
    (folder / "velodyne").mkdir(parents=True)
    for i, cloud in enumerate(CLOUDS):
        points = np.concatenate([cloud, np.ones((len(cloud), 1), np.float32)], axis=1)
        points.astype("<f4").tofile(folder / "velodyne" / f"{i:06}.bin")
    mount = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    calibration = [["P0:", *range(12)], ["Tr:", *mount[:3].ravel()]]
    write_text(folder / "calib.txt", *calibration)
    cameras = POSES @ np.linalg.inv(mount)
    write_text(folder / "poses.txt", *cameras[:, :3].reshape(-1, 12))
    return folder


def test_sequences(tmp_path):
    folder = write_kitti(tmp_path / "sequences" / "07")
    check_stream(open_stream(folder), CLOUDS, POSES)
    (tmp_path / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "poses" / "07.txt")  # as in the benchmark
    check_stream(open_stream(folder), CLOUDS, POSES)


def test_bad_frames(tmp_path):
    folder = write_kitti(tmp_path / "07")
    scan = folder / "velodyne" / "000001.bin"
    scan.write_bytes(scan.read_bytes()[:-3])
    check_bad(open_stream(folder), 1, scan, "477 bytes, expected a multiple of 16")
    scan.write_bytes(b"")
    check_bad(open_stream(folder), 1, "cloud has no finite row among its 0")
    scan.unlink()  # the other scans keep their numbers
    np.testing.assert_allclose(open_stream(folder)[1][1], POSES[2], atol=1e-6)
    path = folder / "poses.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    check_bad(open_stream(folder), 2, f"{path}: 3 poses, none for 000003.bin")
    edit_line(path, 3, " ".join(["0"] * 12))
    stream = open_stream(folder)
    with pytest.raises(BadFrameError, match=re.escape(f"frame 1: {path}, line 3: pose is not")):
        read_frame(stream, 1)


def test_bad_files(tmp_path):
    folder = write_kitti(tmp_path / "sequences" / "07")
    path = folder / "calib.txt"
    for text, message in [
        ("P0: 1 2\n", r"calib\.txt: no line 'Tr:'"),
        ("P0: 1\nTr: 1 2 3\n", r"calib\.txt, line 2: 3 numbers, expected 12"),
        ("Tr: 1 2 x\n", r"calib\.txt, line 1: could not convert"),
        ("Tr: " + 12 * "1 ", r"calib\.txt, line 1: pose is not rigid"),
    ]:
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            kitti_stream(folder)
    (folder / "poses.txt").unlink()
    with pytest.raises(NoPosesError) as error:
        kitti_stream(folder)
    assert str(tmp_path / "poses" / "07.txt") in str(error.value)


def test_without_poses_the_world_is_that_of_the_scanner(tmp_path):
    folder = write_kitti(tmp_path)
    (folder / "poses.txt").unlink()
    (folder / "calib.txt").unlink()
    check_stream(open_stream(folder, poses=False), CLOUDS, IDENTITIES)


def test_times_of_scans(tmp_path):
    folder = write_kitti(tmp_path)
    assert kitti_stream(folder).stamps is None
    write_text(folder / "times.txt", ["0.000000e+00"], ["1.037e-01"], ["2.074e-01"])
    (folder / "velodyne" / "000001.bin").unlink()  # the other scans keep their numbers
    for poses in (True, False):
        np.testing.assert_array_equal(kitti_stream(folder, poses=poses).stamps, [0, 0.2074, np.nan])
