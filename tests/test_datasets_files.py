"""Text files of numbers and numbered files."""

import re

import pytest

from hiosdf_jax._src.datasets.files import numbered_files, read_rows


def test_numbered_files_and_rows(tmp_path):
    for name in ("depth10.png", "depth9.png", "depth9.jpg", "ndepth3.png"):
        (tmp_path / name).touch()
    found = numbered_files(tmp_path, r"depth(\d+)\.png")
    assert [(number, path.name) for number, path in found] == [
        (9, "depth9.png"),
        (10, "depth10.png"),
    ]
    with pytest.raises(ValueError, match=re.escape(f"{tmp_path}: no file name matches")):
        numbered_files(tmp_path, r"(\d+)\.bin")
    (tmp_path / "bytes").write_bytes(b"1 2\n\xff\xfe 3\n")
    with pytest.raises(ValueError, match=r"bytes, line 2: could not convert"):
        read_rows(tmp_path / "bytes", 2)
