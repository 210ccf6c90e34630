"""Exported frames of ScanNet scenes."""

import os
import re
import shutil
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from recordings import (
    IDENTITIES,
    POSES,
    RAW,
    backproject,
    check_bad,
    check_stream,
    write_png,
    write_scannet,
    write_text,
)

from hiosdf_jax.datasets import NoPosesError, open_stream, scannet_stream


def test_exported_frames(tmp_path):
    stream = open_stream(write_scannet(tmp_path))
    check_stream(stream, [backproject(raw, 1000) for raw in RAW], POSES)


def test_frames_without_poses(tmp_path):
    folder = write_scannet(tmp_path)
    shutil.rmtree(folder / "pose")
    with pytest.raises(NoPosesError, match="has no poses, expected them in the folder pose"):
        open_stream(folder)
    clouds = [backproject(raw, 1000) for raw in RAW]
    check_stream(open_stream(folder, poses=False), clouds, IDENTITIES)


@pytest.mark.parametrize("folders", [["depth", "pose"], ["depth"]])
def test_names_with_leading_zeros(tmp_path, folders):
    folder = write_scannet(tmp_path)
    for path in [path for name in folders for path in (folder / name).iterdir()]:
        path.rename(path.with_stem(path.stem.zfill(6)))
    check_stream(open_stream(folder), [backproject(raw, 1000) for raw in RAW], POSES)
    (folder / "pose" / ("000009.txt" if "pose" in folders else "9.txt")).unlink()
    check_bad(scannet_stream(folder), 2, "000009.txt: No such file or directory")
    write_png(folder / "depth" / "9.png", RAW[0])
    with pytest.raises(ValueError, match=r"000009\.png: is frame 9, as is 9\.png, expected one"):
        scannet_stream(folder)


def test_a_skewed_camera(tmp_path):
    folder = write_scannet(tmp_path)
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    matrix = np.loadtxt(path)
    matrix[0, 1] = 0.5
    write_text(path, *matrix)
    cloud, _ = scannet_stream(folder)[0]
    pixels = cloud @ matrix[:3, :3].T
    v, u = np.divmod(np.arange(len(cloud)), RAW.shape[2])
    seen = RAW[0].ravel() > 0
    expected = np.stack([u, v], axis=-1)[seen]
    np.testing.assert_allclose((pixels[:, :2] / pixels[:, 2:])[seen], expected, atol=1e-4)


def test_bad_frames(tmp_path):
    folder = write_scannet(tmp_path)
    path = folder / "pose" / "9.txt"
    whole = path.read_text()
    write_text(path, *np.full((4, 4), -np.inf))  # ScanNet's mark for lost tracking
    check_bad(scannet_stream(folder), 2, f"{path}: pose has values that are not finite")
    path.write_text("".join(whole.splitlines(keepends=True)[:3]))
    check_bad(scannet_stream(folder), 2, f"{path}: 3 lines, expected 4")
    path.write_text(whole[:-10])
    check_bad(scannet_stream(folder), 2, f"{path}, line 4: ")
    path.unlink()
    check_bad(scannet_stream(folder), 2, f"{path}: No such file or directory")


def test_bad_files(tmp_path):
    folder = write_scannet(tmp_path)
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    matrix = np.loadtxt(path)
    for wrong, reason in ((0 * matrix, "focal lengths > 0"), (matrix.T, "is it transposed?")):
        write_text(path, *wrong)
        message = f"{re.escape(f'{path}: camera matrix is [[')}.*{re.escape(reason)}"
        with pytest.raises(ValueError, match=message):
            scannet_stream(folder)
    path.unlink()
    with pytest.raises(FileNotFoundError):
        scannet_stream(folder)


def test_images_are_checked_before_they_are_decoded(tmp_path):
    """A kilobyte may declare gigabytes, and a pipe may never end."""
    folder = write_scannet(tmp_path)
    path = folder / "depth" / "9.png"
    whole = path.read_bytes()
    for width, height, reason in (
        (9000, 9000, "9000 x 9000 pixels, expected at most 2097152"),
        (30_000, 30_000, "decompression bomb"),
        (2**31 - 1, 2**31 - 1, "not a readable PNG image"),
    ):
        head = b"IHDR" + struct.pack(">II", width, height) + whole[24:29]
        path.write_bytes(whole[:12] + head + struct.pack(">I", zlib.crc32(head)) + whole[33:])
        tracemalloc.start()
        check_bad(scannet_stream(folder), 2, path, reason)
        assert tracemalloc.get_traced_memory()[1] < 10e6
        tracemalloc.stop()
    path.unlink()
    os.mkfifo(path)
    check_bad(scannet_stream(folder), 2, f"{path}: is a pipe or a device, expected a file")
