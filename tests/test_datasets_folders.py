"""Readers of folders: tiny ones are written in each layout and compared number by number."""

import json
import re

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from hiosdf_jax.datasets import (
    BadFrameError,
    find_bounds,
    kitti_stream,
    open_stream,
    read_frame,
    replicacad_stream,
    scannet_stream,
    tum_stream,
)

FX, FY, CX, CY = 6.0, 5.0, 3.3, 2.1
INTRINSICS = (FX, FY, CX, CY)
FRAMES = 4
RNG = np.random.default_rng(0)
RAW = RNG.integers(500, 9000, (FRAMES, 5, 7)).astype(np.uint16)
RAW[:, 1, 2] = 0  # no return
CLOUDS = RNG.uniform(-4, 4, (FRAMES, 30, 3)).astype(np.float32)
POSES = np.tile(np.eye(4), (FRAMES, 1, 1))
POSES[:, :3, :3] = Rotation.random(FRAMES, random_state=RNG).as_matrix()
POSES[:, :3, 3] = RNG.uniform(-2, 2, (FRAMES, 3))


def write_png(path, raw):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(raw).save(path)


def write_text(path, *rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))


def edit_line(path, number, text):
    """Replaces a line, counted from 1."""
    lines = path.read_text().splitlines()
    lines[number - 1] = text
    path.write_text("\n".join(lines))


def backproject(raw, scale):
    """The pinhole model, one pixel at a time."""
    cloud = np.full((raw.size, 3), np.nan)
    for v in range(raw.shape[0]):
        for u in range(raw.shape[1]):
            z = int(raw[v, u]) / scale
            if z:
                cloud[v * raw.shape[1] + u] = [(u - CX) / FX * z, (v - CY) / FY * z, z]
    return cloud


def check_stream(stream, clouds, poses, atol=1e-5):
    assert len(stream) == len(clouds)
    for i, (cloud, pose) in enumerate(stream):
        assert cloud.dtype == pose.dtype == np.float32
        np.testing.assert_allclose(cloud, clouds[i], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(pose, poses[i], atol=atol)
    with pytest.raises(IndexError, match=f"expected one of {len(clouds)} frames"):
        stream[len(clouds)]
    np.testing.assert_array_equal(stream[-1][1], stream[len(clouds) - 1][1])
    seen = [c @ p[:3, :3].T + p[:3, 3] for c, p in zip(clouds, poses, strict=True)]
    low, high = find_bounds(stream, margin=0.1).bounds
    seen = np.concatenate(seen)
    seen = seen[np.isfinite(seen).all(axis=1)]
    assert ((seen > low) & (seen < high)).all(axis=1).mean() > 0.9
    seen = np.concatenate([seen, np.asarray(poses)[:, :3, 3]])
    assert (seen.min(axis=0) - 0.11 < low).all()
    assert (seen.max(axis=0) + 0.11 > high).all()


def check_bad(stream, frame, *messages):
    """One frame is bad and says why; the others, and the bounds without it, are there."""
    with pytest.raises(BadFrameError) as error:
        read_frame(stream, frame)
    text = str(error.value)
    assert text.startswith(f"frame {frame}: ")
    assert "\n" not in text
    for message in messages:
        assert str(message) in text
    for i in range(len(stream)):
        if i != frame:
            read_frame(stream, i)
    with pytest.raises(BadFrameError, match=f"^frame {frame}: "):
        find_bounds(stream)
    assert find_bounds(stream, skip_bad_frames=True).max_range > 0.5


# iSDF's ReplicaCAD and NICE-SLAM's Replica


def write_replicacad(folder):
    for i in range(FRAMES):
        write_png(folder / "results" / f"depth{i:06}.png", RAW[i])
        write_png(folder / "results" / f"ndepth{i:06}.png", RAW[i] + 9)  # iSDF's noisy ones
    write_text(folder / "traj.txt", *POSES.reshape(-1, 16))
    camera = {"w": 7, "h": 5, "fx": FX, "fy": FY, "cx": CX, "cy": CY}
    info = {"camera": camera, "depth_scale": 3276.75, "fps": 30}
    (folder / "replicaCAD_info.json").write_text(json.dumps(info))
    return folder


def test_replicacad(tmp_path):
    folder = write_replicacad(tmp_path / "apt_2_nav")
    clouds = [backproject(raw, 3276.75) for raw in RAW]
    check_stream(open_stream(folder), clouds, POSES)
    # As iSDF's archive has it: one file for all sequences, above them.
    (folder / "replicaCAD_info.json").rename(tmp_path / "replicaCAD_info.json")
    check_stream(replicacad_stream(folder), clouds, POSES)


def test_replica(tmp_path):
    folder = write_replicacad(tmp_path / "room0")
    info = json.loads((folder / "replicaCAD_info.json").read_text())
    (folder / "replicaCAD_info.json").unlink()
    info["camera"]["scale"] = 6553.5
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": info["camera"]}))
    check_stream(open_stream(folder), [backproject(raw, 6553.5) for raw in RAW], POSES)


def test_bad_frames_of_replicacad(tmp_path):
    folder = write_replicacad(tmp_path)
    path = folder / "traj.txt"
    whole = path.read_text()
    edit_line(path, 2, " ".join(["nan"] * 16))
    check_bad(open_stream(folder), 1, f"{path}, line 2: pose has values that are not finite")
    path.write_text("".join(whole.splitlines(keepends=True)[:3]))
    check_bad(open_stream(folder), 3, f"{path}: 3 poses, none for depth000003.png")
    path.write_text(whole)
    image = folder / "results" / "depth000002.png"
    image.write_bytes(image.read_bytes()[:50])
    check_bad(open_stream(folder), 2, image, "not a readable PNG image")
    write_png(image, RAW[2][:, :4])
    check_bad(open_stream(folder), 2, image, "image of 4 x 5 pixels, expected 7 x 5")
    write_png(image, np.zeros((5, 7, 3), np.uint8))
    check_bad(open_stream(folder), 2, image, "expected one channel of 16 bits")
    write_png(image, 0 * RAW[2])
    check_bad(open_stream(folder), 2, "cloud has no finite row among its 35")


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("traj.txt", "1 2 3", "traj.txt, line 1: 3 columns, expected 16"),
        ("replicaCAD_info.json", "{", "replicaCAD_info.json: not a readable JSON file"),
        ("replicaCAD_info.json", "{}", "replicaCAD_info.json: KeyError('camera'), expected"),
        ("replicaCAD_info.json", '{"camera": {"scale": 0}}', "KeyError('fx')"),
    ],
)
def test_bad_files_of_replicacad(tmp_path, name, edit, message):
    folder = write_replicacad(tmp_path)
    (folder / name).write_text(edit)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        open_stream(folder)
    assert str(error.value).startswith(str(folder))


def test_values_out_of_range_of_replicacad(tmp_path):
    path = write_replicacad(tmp_path) / "replicaCAD_info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {"depth_scale": 0}))
    with pytest.raises(ValueError, match=r"info\.json: depth scale is 0\.0, expected > 0"):
        open_stream(tmp_path)
    path.write_text(json.dumps(info | {"camera": info["camera"] | {"fx": -1}}))
    with pytest.raises(ValueError, match=r"info\.json: intrinsics are \[-1\.0, .*expected fx, fy"):
        open_stream(tmp_path)
    path.unlink()
    with pytest.raises(ValueError, match="neither it nor the folder above has one of"):
        open_stream(tmp_path)


# ScanNet


def write_scannet(folder):
    for i, n in enumerate([0, 2, 9, 10]):  # not all frames, and 10 after 9
        write_png(folder / "depth" / f"{n}.png", RAW[i])
        write_text(folder / "pose" / f"{n}.txt", *POSES[i])
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[:2, 2] = FX, FY, [CX, CY]
    write_text(folder / "intrinsic" / "intrinsic_depth.txt", *matrix)
    return folder


def test_scannet(tmp_path):
    stream = open_stream(write_scannet(tmp_path))
    check_stream(stream, [backproject(raw, 1000) for raw in RAW], POSES)


def test_bad_frames_of_scannet(tmp_path):
    folder = write_scannet(tmp_path)
    path = folder / "pose" / "9.txt"
    whole = path.read_text()
    write_text(path, *np.full((4, 4), -np.inf))  # what ScanNet writes when it is lost
    check_bad(scannet_stream(folder), 2, f"{path}: pose has values that are not finite")
    path.write_text("".join(whole.splitlines(keepends=True)[:3]))
    check_bad(scannet_stream(folder), 2, f"{path}: 3 lines, expected 4")
    path.write_text(whole[:-10])
    check_bad(scannet_stream(folder), 2, f"{path}, line 4: ")
    path.unlink()
    check_bad(scannet_stream(folder), 2, f"{path}: No such file or directory")


def test_bad_files_of_scannet(tmp_path):
    folder = write_scannet(tmp_path)
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    write_text(path, *np.zeros((4, 4)))
    with pytest.raises(ValueError, match=re.escape(f"{path}: intrinsics are [0.0, ")):
        scannet_stream(folder)
    path.unlink()
    with pytest.raises(FileNotFoundError):
        scannet_stream(folder)


# TUM RGB-D


def quaternions(poses):
    return Rotation.from_matrix(np.asarray(poses)[:, :3, :3]).as_quat()


def write_tum(folder, raw=RAW):
    stamps = 1305031453.3741 + 0.03 * np.arange(len(raw))
    names = [f"depth/{stamp:.6f}.png" for stamp in stamps]
    for name, image in zip(names, raw, strict=True):
        write_png(folder / name, image)
    rows = [("#", "depth", "maps"), *zip((f"{s:.6f}" for s in stamps), names, strict=True)]
    write_text(folder / "depth.txt", *rows)
    # Two poses around each image, so that the middle one is the image's.
    rows = []
    for stamp, pose, quaternion in zip(stamps, POSES, quaternions(POSES), strict=False):
        step = np.array([0.2, -0.1, 0.3])
        rows.append([f"{stamp - 0.004:.6f}", *(pose[:3, 3] - step), *quaternion])
        rows.append([f"{stamp + 0.004:.6f}", *(pose[:3, 3] + step), *-quaternion])
    write_text(folder / "groundtruth.txt", ["#", "timestamp"], *rows)
    return folder


def test_tum(tmp_path):
    folder = write_tum(tmp_path / "desk")
    stream = open_stream(folder, intrinsics=INTRINSICS)
    # Stamps of microseconds that are written and read: 2e-7 s of 0.008 s.
    check_stream(stream, [backproject(raw, 5000) for raw in RAW], POSES, atol=1e-4)
    with pytest.raises(ValueError, match="intrinsics are not known, expected them to be given or"):
        open_stream(folder)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rgbd_dataset_freiburg1_xyz", (517.3, 516.5, 318.6, 255.3)),
        ("rgbd_dataset_freiburg2_desk", (520.9, 521.0, 325.1, 249.7)),
        ("fr3_office", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_tum_knows_the_freiburg_cameras(tmp_path, name, expected):
    raw = np.zeros((1, 480, 640), np.uint16)
    raw[0, 100, 200] = 10000
    cloud, _ = open_stream(write_tum(tmp_path / name, raw))[0]
    fx, fy, cx, cy = expected
    point = [(200 - cx) / fx * 2, (100 - cy) / fy * 2, 2]
    np.testing.assert_allclose(cloud[np.isfinite(cloud).all(axis=1)], [point], rtol=1e-5)


def test_bad_frames_of_tum(tmp_path):
    folder = write_tum(tmp_path)
    path = folder / "groundtruth.txt"
    whole = path.read_text()
    path.write_text("".join(whole.splitlines(keepends=True)[:-2]))
    stream = tum_stream(folder, INTRINSICS)
    check_bad(stream, 3, f"{path}: no pose for 1305031453.464100 s; the nearest is 0.026 s away")
    path.write_text(whole)
    edit_line(path, 7, "1305031453.4381 0 0 0 0 0 0 0")
    check_bad(tum_stream(folder, INTRINSICS), 2, f"{path}, line 7: quaternion has length 0")
    path.write_text(whole)
    (folder / "depth" / "1305031453.404100.png").unlink()
    check_bad(tum_stream(folder, INTRINSICS), 1, "404100.png: No such file or directory")
    with pytest.raises(ValueError, match="image of 7 x 5 pixels, expected 640 x 480"):
        folder.rename(tmp_path.parent / f"{tmp_path.name}_freiburg1")
        open_stream(tmp_path.parent / f"{tmp_path.name}_freiburg1")[0]


def test_bad_files_of_tum(tmp_path):
    folder = write_tum(tmp_path)
    edit_line(folder / "depth.txt", 3, "soon depth/1.png")
    with pytest.raises(ValueError, match=r"depth\.txt, line 3: could not convert"):
        tum_stream(folder, INTRINSICS)
    (folder / "depth.txt").write_text("# nothing\n")
    with pytest.raises(ValueError, match=r"depth\.txt: no image in it"):
        tum_stream(folder, INTRINSICS)
    with pytest.raises(ValueError, match=r"intrinsics are \[1.0, 2.0\], expected fx, fy > 0"):
        tum_stream(write_tum(tmp_path), (1, 2))


# KITTI odometry


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


def test_kitti(tmp_path):
    folder = write_kitti(tmp_path / "sequences" / "07")
    check_stream(open_stream(folder), CLOUDS, POSES)
    (tmp_path / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "poses" / "07.txt")  # as the benchmark has it
    check_stream(open_stream(folder), CLOUDS, POSES)


def test_bad_frames_of_kitti(tmp_path):
    folder = write_kitti(tmp_path / "07")
    scan = folder / "velodyne" / "000001.bin"
    scan.write_bytes(scan.read_bytes()[:-3])
    check_bad(open_stream(folder), 1, scan, "477 bytes, expected a multiple of 16")
    scan.write_bytes(b"")
    check_bad(open_stream(folder), 1, "cloud has no finite row among its 0")
    scan.unlink()  # the scans keep their numbers
    np.testing.assert_allclose(open_stream(folder)[1][1], POSES[2], atol=1e-6)
    path = folder / "poses.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    check_bad(open_stream(folder), 2, f"{path}: 3 poses, none for 000003.bin")
    edit_line(path, 3, " ".join(["0"] * 12))
    stream = open_stream(folder)
    with pytest.raises(BadFrameError, match=re.escape(f"frame 1: {path}, line 3: pose is not")):
        read_frame(stream, 1)


def test_bad_files_of_kitti(tmp_path):
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
    with pytest.raises(FileNotFoundError) as error:
        kitti_stream(folder)
    assert str(error.value.filename) == str(tmp_path / "poses" / "07.txt")


# PLY and PCD


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
        # In seconds and in nanoseconds, then by order: of numbers, of names.
        (["100.5", "100.6", "100.7", "100.8"], [100.5, 100.6, 100.7, 100.8]),
        ([1403636579763555584 + 10**8 * i for i in range(4)], None),
        (["9", "10", "11", "100"], [0.1, 0.2, 0.3, 0.4]),
        (["scan_2", "scan_10", "scan_11", "scan_200"], [0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_clouds(tmp_path, names, stamps, suffix):
    folder = write_clouds(tmp_path, names, suffix)
    write_poses(tmp_path / "poses.txt", stamps or [f"{name * 1e-9:.7f}" for name in names])
    check_stream(open_stream(folder), CLOUDS, POSES, atol=1e-4)


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
                continue  # still all columns: nothing tells that digits are missing
            path.write_bytes(broken)
            check_bad(open_stream(folder), i, path, f"not a readable {kind} file")
        path.write_bytes(whole)
    empty = whole.replace(b"30", b"0").split(b"DATA")[0].split(b"end_header")[0]
    path.write_bytes(empty + (b"end_header\n" if suffix == ".ply" else b"DATA ascii\n"))
    check_bad(open_stream(folder), 1, "cloud has no finite row among its 0")


def test_clouds_without_poses(tmp_path):
    folder = write_clouds(tmp_path, [1, 2, 3, 4])
    with pytest.raises(ValueError, match=r"trajectory is one of \[\], expected one \.txt or"):
        open_stream(folder)
    write_poses(folder / "poses.txt", [2, 2.9, 3.05, 5])
    # Times inside are times, although there are as many poses: 1 and 4 have none near.
    stream = open_stream(folder)
    np.testing.assert_allclose(stream[1][1], POSES[0], atol=1e-6)
    assert np.isfinite(stream[2][1]).all()
    for i in (0, 3):
        with pytest.raises(BadFrameError, match=f"frame {i}: .*no pose for {i + 1}.000000 s"):
            read_frame(stream, i)
    write_poses(folder / "poses.txt", [7, 8, 9, 10])
    np.testing.assert_allclose(open_stream(folder)[0][1], POSES[0], atol=1e-6)
    edit_line(folder / "poses.txt", 4, "")
    with pytest.raises(ValueError, match=r"3 poses from 7\.0+ to 9\.0+ s for the 4 clouds 1\.ply"):
        open_stream(folder)
    write_poses(folder / "more.txt", range(4))
    with pytest.raises(ValueError, match=r"trajectory is one of \['more\.txt', 'poses\.txt'\]"):
        open_stream(folder)
    assert len(open_stream(folder, trajectory=folder / "more.txt")) == 4


# Which layout it is


def test_unclear_layouts(tmp_path):
    with pytest.raises(FileNotFoundError):
        open_stream(tmp_path / "none")
    with pytest.raises(ValueError, match="looks like no known format"):
        open_stream(tmp_path)
    (tmp_path / "note.las").touch()
    with pytest.raises(ValueError, match=r"note\.las: looks like no known format"):
        open_stream(tmp_path / "note.las")
    write_tum(write_scannet(tmp_path))
    with pytest.raises(ValueError, match=r"looks like \['scannet', 'tum'\], expected one"):
        open_stream(tmp_path)
    assert len(open_stream(tmp_path, "tum", intrinsics=INTRINSICS)) == FRAMES
    with pytest.raises(ValueError, match="intrinsics is not an option of format 'scannet'"):
        open_stream(tmp_path, "scannet", intrinsics=INTRINSICS)
    with pytest.raises(ValueError, match="format = 'TUM', expected one of"):
        open_stream(tmp_path, "TUM")
