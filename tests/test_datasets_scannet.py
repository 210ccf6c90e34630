"""Exported frames of ScanNet scenes."""

import re

import numpy as np
import pytest
from recordings import POSES, RAW, backproject, check_bad, check_stream, write_scannet, write_text

from hiosdf_jax.datasets import open_stream, scannet_stream


def test_exported_frames(tmp_path):
    stream = open_stream(write_scannet(tmp_path))
    check_stream(stream, [backproject(raw, 1000) for raw in RAW], POSES)


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
    write_text(path, *np.zeros((4, 4)))
    with pytest.raises(ValueError, match=re.escape(f"{path}: intrinsics are [0.0, ")):
        scannet_stream(folder)
    path.unlink()
    with pytest.raises(FileNotFoundError):
        scannet_stream(folder)
