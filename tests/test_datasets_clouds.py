"""Folders of PLY and PCD clouds with a trajectory."""

import os
import struct

import numpy as np
import pytest
import trimesh
from recordings import (
    CLOUDS,
    FRAMES,
    IDENTITIES,
    POSES,
    check_bad,
    check_stream,
    edit_line,
    quaternions,
    write_text,
)

from hiosdf_jax.datasets import BadFrameError, NoPosesError, open_stream, read_frame


def write_clouds(folder, names, suffix=".ply"):
    from pypcd4 import Encoding, PointCloud

    folder.mkdir(parents=True, exist_ok=True)
    encodings = [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED]
    for i, name in enumerate(names):
        path = folder / f"{name}{suffix}"
        if suffix == ".pcd":
            content = PointCloud.from_xyzi_points(np.c_[CLOUDS[i], CLOUDS[i, :, 0]])
            content.save(path, encoding=encodings[i % 3])
        else:
            text = ["ascii", "binary"][i % 2]
            trimesh.PointCloud(CLOUDS[i]).export(path, encoding=text)
    return folder


def write_poses(path, stamps):
    rows = zip(stamps, POSES, quaternions(POSES), strict=True)
    write_text(path, *([stamp, *pose[:3, 3], *quaternion] for stamp, pose, quaternion in rows))


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        # Names are times in seconds or nanoseconds; then the order of numbers, of names.
        (["100.5", "100.6", "100.7", "100.8"], [100.5, 100.6, 100.7, 100.8]),
        ([1403636579763555584 + 10**8 * i for i in range(4)], None),
        (["9", "10", "11", "100"], [0.1, 0.2, 0.3, 0.4]),
        (["9.9", "10.0", "10.05", "10.1"], [9.9, 10.0, 10.05, 10.1]),  # 5 hundredths come before 1
        (["-1", "0", "1", "2"], [-1, 0, 1, 2]),
        (["1.1", "1.2", "1.9", "1.10"], [7, 8, 9, 10]),  # versions, of which two are one number
        (["1_9", "1_10", "2_1", "2_2"], [7, 8, 9, 10]),
        (["1", "2", "3", "4"], [0, 1, 2, 3]),  # times that only number the poses
        (["scan_2", "scan_10", "scan_11", "scan_200"], [0.1, 0.2, 0.3, 0.4]),
        (["2", "10", "11\u00b2", "200"], [0.1, 0.2, 0.3, 0.4]),  # a digit that is no number
    ],
)
def test_folders_of_clouds(tmp_path, names, stamps, suffix):
    folder = write_clouds(tmp_path, names, suffix)
    write_poses(tmp_path / "poses.txt", stamps or [f"{name * 1e-9:.7f}" for name in names])
    check_stream(open_stream(folder), CLOUDS, POSES, atol=1e-4)


def test_the_trajectory_of_a_run_numbers_the_clouds(tmp_path):
    folder = write_clouds(tmp_path, range(1, FRAMES + 1))
    path = folder / "trajectory.txt"
    write_poses(path, range(FRAMES))
    rows = path.read_text().splitlines(keepends=True)
    path.write_text("# frame tx ty tz qx qy qz qw\n" + "".join(rows[:1] + rows[2:]))
    stream = open_stream(folder)
    for i in (0, 2, 3):
        np.testing.assert_allclose(stream[i][1], POSES[i], atol=1e-6)
    check_bad(stream, 1, path, "no pose for 1.000000 s")


@pytest.mark.parametrize("suffix", [".PLY", ".PCD"])
def test_endings_of_any_case(tmp_path, suffix):
    folder = write_clouds(tmp_path, range(FRAMES), suffix.lower())
    for i in (0, 2):
        (folder / f"{i}{suffix.lower()}").rename(folder / f"{i}{suffix}")
    write_poses(tmp_path / "poses.txt", range(FRAMES))
    check_stream(open_stream(folder), CLOUDS, POSES)
    for each in (1, 3):
        (folder / f"{each}{suffix.lower()}").unlink()
    assert len(open_stream(folder)) == 2


def test_cloud_poses_are_interpolated(tmp_path):
    folder = write_clouds(tmp_path / "clouds", ["10.025"])
    write_text(tmp_path / "gps.txt", [10, 1, 2, 3, 0, 0, 0, 1], [10.1, 1, 4, 3, 0, 0, 0, 1])
    _, pose = open_stream(folder, trajectory=tmp_path / "gps.txt")[0]
    np.testing.assert_allclose(pose[:3, 3], [1, 2.5, 3], atol=1e-5)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_keep_their_order_and_nan(tmp_path, suffix, encoding):
    from pypcd4 import Encoding, PointCloud

    points = np.float32([[1, 2, 3], [np.nan, 0, 1], [1, 2, 3], [-1e-3, 5, 1e4]])
    if suffix == ".ply":
        trimesh.PointCloud(points).export(tmp_path / "0.ply", encoding=encoding)
    else:
        PointCloud.from_xyz_points(points).save(tmp_path / "0.pcd", encoding=Encoding(encoding))
    write_text(tmp_path / "poses.txt", [0, 0, 0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(open_stream(tmp_path)[0][0], points, rtol=1e-6)


def test_a_mesh_and_a_single_point_are_clouds(tmp_path):
    from pypcd4 import Encoding, PointCloud

    box = trimesh.creation.box((1, 2, 3))
    box.export(tmp_path / "0.ply")
    point = np.float32([[1, 2, 3]])
    PointCloud.from_xyz_points(point).save(tmp_path / "1.pcd", encoding=Encoding.ASCII)
    write_text(tmp_path / "poses.txt", *([i, 0, 0, 0, 0, 0, 0, 1] for i in range(2)))
    stream = open_stream(tmp_path)
    np.testing.assert_allclose(stream[0][0], box.vertices, rtol=1e-6)
    np.testing.assert_allclose(stream[1][0], point, rtol=1e-6)


@pytest.mark.parametrize(("suffix", "kind"), [(".ply", "PLY"), (".pcd", "PCD")])
def test_bad_clouds(tmp_path, suffix, kind):
    folder = write_clouds(tmp_path, range(FRAMES), suffix)
    write_poses(tmp_path / "poses.txt", range(FRAMES))
    for i in (0, 1):  # ASCII, binary
        path = folder / f"{i}{suffix}"
        whole = path.read_bytes()
        end = whole.rstrip(b"\n").rfind(b"\n") + 1 if i == 0 else len(whole) - 16
        for broken in (b"", b"some text\n", whole[:40], whole[:end], whole[:-5]):
            if broken == whole[:-5] and i == 0:
                continue  # all columns are there: missing digits cannot be detected
            path.write_bytes(broken)
            check_bad(open_stream(folder), i, path, f"not a readable {kind} file")
        path.write_bytes(whole)
    empty = whole.replace(b"30", b"0").split(b"DATA")[0].split(b"end_header")[0]
    path.write_bytes(empty + (b"end_header\n" if suffix == ".ply" else b"DATA ascii\n"))
    check_bad(open_stream(folder), 1, "cloud has no finite row among its 0")


def test_clouds_without_poses(tmp_path):
    folder = write_clouds(tmp_path, [1, 2, 3, 4])
    with pytest.raises(NoPosesError, match=r"has no poses, expected a trajectory in a \.txt or"):
        open_stream(folder)
    write_poses(folder / "poses.txt", [2, 2.9, 3.05, 5])
    # By time, 2 has the first pose; by order, the second.
    message = (
        r"poses\.txt: 4 poses for as many clouds, but none at the time of 1\.ply; expected one"
    )
    with pytest.raises(ValueError, match=message):
        open_stream(folder)
    # Names within the trajectory are times. Now 1 and 4 have no pose near.
    with open(folder / "poses.txt", "a") as file:
        file.write("6 0 0 0 0 0 0 1")
    stream = open_stream(folder)
    np.testing.assert_allclose(stream[1][1], POSES[0], atol=1e-6)
    assert np.isfinite(stream[2][1]).all()
    for i in (0, 3):
        with pytest.raises(BadFrameError, match=f"frame {i}: .*no pose for {i + 1}.000000 s"):
            read_frame(stream, i)
    # As many poses that agree with the order, but for the one that is missing.
    write_poses(folder / "poses.txt", [1.5, 2, 3, 4])
    check_bad(open_stream(folder), 0, "no pose for 1.000000 s")
    np.testing.assert_allclose(open_stream(folder)[3][1], POSES[3], atol=1e-6)
    write_poses(folder / "poses.txt", [7, 8, 9, 10])
    np.testing.assert_allclose(open_stream(folder)[0][1], POSES[0], atol=1e-6)
    edit_line(folder / "poses.txt", 4, "")
    with pytest.raises(ValueError, match=r"3 poses from 7\.0+ to 9\.0+ s for the 4 clouds 1\.ply"):
        open_stream(folder)
    write_poses(folder / "more.txt", range(4))
    with pytest.raises(ValueError, match=r"trajectory is one of \['more\.txt', 'poses\.txt'\]"):
        open_stream(folder)
    assert len(open_stream(folder, trajectory=folder / "more.txt")) == 4


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["9.5", "10", "10.25", "11"], [9.5, 10, 10.25, 11]),
        (
            [1403636579763555584 + 10**8 * i for i in range(4)],
            1403636579.763555584 + 0.1 * np.arange(4),
        ),
        (["scan_2", "scan_10", "scan_11", "scan_20"], [np.nan] * 4),
    ],
)
def test_clouds_whose_poses_are_not_read(tmp_path, names, stamps):
    stream = open_stream(write_clouds(tmp_path, names), poses=False)
    check_stream(stream, CLOUDS, IDENTITIES)
    np.testing.assert_allclose(stream.stamps, stamps, rtol=1e-15)


def test_times_of_clouds_are_those_of_their_poses(tmp_path):
    folder = write_clouds(tmp_path, ["a", "b", "c", "d"])
    write_poses(folder / "poses.txt", [7, 8, 9, 10])
    np.testing.assert_array_equal(open_stream(folder).stamps, [7, 8, 9, 10])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ((b"COUNT 1 1 1 1", b"COUNT 1 1 1 2000000000"), "of 2000000003 values, expected at most"),
        ((b"POINTS 30", b"POINTS 3000000000"), "declares 3000000000 points"),
        ((b"POINTS 30", b"POINTS 31"), "bytes of data, expected 4"),
        ((b"DATA binary", b"DATA binary_compressed"), "inflates to"),
    ],
)
def test_a_pcd_file_must_hold_what_it_declares(tmp_path, change, reason):
    folder = write_clouds(tmp_path, range(FRAMES), ".pcd")
    write_poses(tmp_path / "poses.txt", range(FRAMES))
    path = folder / "1.pcd"  # binary
    whole = path.read_bytes()
    assert change[0] in whole
    path.write_bytes(whole.replace(*change))
    check_bad(open_stream(folder), 1, path, "not a readable PCD file", reason)


def test_a_ply_file_must_hold_what_it_declares_and_opens_no_other(tmp_path):
    folder = write_clouds(tmp_path, range(FRAMES))
    write_poses(tmp_path / "poses.txt", range(FRAMES))
    path = folder / "1.ply"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"element vertex 30", b"element vertex 3000000000"))
    check_bad(open_stream(folder), 1, path, "it declares 3000000000 of vertex in")
    os.mkfifo(folder / "pipe.png")
    path.write_bytes(whole.replace(b"format", b"comment TextureFile pipe.png\nformat", 1))
    np.testing.assert_array_equal(open_stream(folder)[1][0], CLOUDS[1])


def test_a_compressed_pcd_file_inflates_to_a_limit(tmp_path):
    folder = write_clouds(tmp_path, range(FRAMES), ".pcd")
    write_poses(tmp_path / "poses.txt", range(FRAMES))
    path = folder / "1.pcd"
    points, values = 200_000, 500
    path.write_bytes(
        f"VERSION .7\nFIELDS x y z q\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 {values - 3}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\n"
        "DATA binary_compressed\n".encode()
        + struct.pack("<II", 8, points * values * 4)
        + bytes(8)
    )
    reason = "inflates to 400000000 bytes, expected at most 67108864"
    check_bad(open_stream(folder), 1, path, "not a readable PCD file", reason)
