"""Sequences in the layout of the TUM RGB-D benchmark."""

import numpy as np
import pytest
from recordings import (
    IDENTITIES,
    INTRINSICS,
    POSES,
    RAW,
    backproject,
    check_bad,
    check_stream,
    edit_line,
    write_tum,
)

from hiosdf_jax.datasets import NoPosesError, open_stream, tum_stream


def test_sequences(tmp_path):
    folder = write_tum(tmp_path / "desk")
    stream = open_stream(folder, intrinsics=INTRINSICS)
    # Stamps are written in whole microseconds: an error of up to 2e-7 s in 0.008 s.
    check_stream(stream, [backproject(raw, 5000) for raw in RAW], POSES, atol=1e-4)
    with pytest.raises(ValueError, match="unknown camera, expected intrinsics or a folder"):
        open_stream(folder)


def test_images_without_poses_have_times(tmp_path):
    folder = write_tum(tmp_path)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(NoPosesError, match=r"has no poses, expected them in groundtruth\.txt"):
        open_stream(folder, intrinsics=INTRINSICS)
    stream = open_stream(folder, intrinsics=INTRINSICS, poses=False)
    check_stream(stream, [backproject(raw, 5000) for raw in RAW], IDENTITIES)
    np.testing.assert_allclose(stream.stamps, 1305031453.3741 + 0.03 * np.arange(4), rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rgbd_dataset_freiburg1_xyz", (517.3, 516.5, 318.6, 255.3)),
        ("rgbd_dataset_freiburg2_desk", (520.9, 521.0, 325.1, 249.7)),
        ("fr3_office", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_folder_names_give_the_freiburg_cameras(tmp_path, name, expected):
    raw = np.zeros((1, 480, 640), np.uint16)
    raw[0, 100, 200] = 10000
    cloud, _ = open_stream(write_tum(tmp_path / name, raw))[0]
    fx, fy, cx, cy = expected
    point = [(200 - cx) / fx * 2, (100 - cy) / fy * 2, 2]
    np.testing.assert_allclose(cloud[np.isfinite(cloud).all(axis=1)], [point], rtol=1e-5)


def test_bad_frames(tmp_path):
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


def test_bad_files(tmp_path):
    folder = write_tum(tmp_path)
    edit_line(folder / "depth.txt", 3, "soon depth/1.png")
    with pytest.raises(ValueError, match=r"depth\.txt, line 3: could not convert"):
        tum_stream(folder, INTRINSICS)
    (folder / "depth.txt").write_text("# nothing\n")
    with pytest.raises(ValueError, match=r"depth\.txt: has no image, expected at least one"):
        tum_stream(folder, INTRINSICS)
    with pytest.raises(ValueError, match=r"intrinsics are \[1.0, 2.0\], expected fx, fy > 0"):
        tum_stream(write_tum(tmp_path), (1, 2))
