"""Recognition of the layout of a stream."""

import pytest
from recordings import FRAMES, INTRINSICS, write_scannet, write_tum

from hiosdf_jax.datasets import open_stream


def test_a_path_of_another_type_is_refused():
    with pytest.raises(
        ValueError, match="path is a NoneType, expected the name of a file or folder"
    ):
        open_stream(None)


def test_unknown_and_ambiguous_layouts(tmp_path):
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
    with pytest.raises(ValueError, match=r"expected one of \[\]$"):
        open_stream(tmp_path, "scannet", trajectory="poses.txt")
    with pytest.raises(ValueError, match="format = 'TUM', expected one of"):
        open_stream(tmp_path, "TUM")
