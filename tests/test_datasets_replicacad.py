"""Sequences in the layout of iSDF's ReplicaCAD and of NICE-SLAM's Replica."""

import json
import re

import numpy as np
import pytest
from recordings import (
    CX,
    CY,
    FRAMES,
    FX,
    FY,
    IDENTITIES,
    POSES,
    RAW,
    backproject,
    check_bad,
    check_stream,
    edit_line,
    write_png,
    write_text,
)

from hiosdf_jax.datasets import NoPosesError, open_stream, read_frame, replicacad_stream


def write_replicacad(folder):
    for i in range(FRAMES):
        write_png(folder / "results" / f"depth{i:06}.png", RAW[i])
        write_png(folder / "results" / f"ndepth{i:06}.png", RAW[i] + 9)  # iSDF's noisy ones
    write_text(folder / "traj.txt", *POSES.reshape(-1, 16))
    camera = {"w": 7, "h": 5, "fx": FX, "fy": FY, "cx": CX, "cy": CY}
    info = {"camera": camera, "depth_scale": 3276.75, "fps": 30}
    (folder / "replicaCAD_info.json").write_text(json.dumps(info))
    return folder


def test_sequences_of_isdf(tmp_path):
    folder = write_replicacad(tmp_path / "apt_2_nav")
    clouds = [backproject(raw, 3276.75) for raw in RAW]
    check_stream(open_stream(folder), clouds, POSES)
    # As in iSDF's archive: one file for all sequences, in their parent folder.
    (folder / "replicaCAD_info.json").rename(tmp_path / "replicaCAD_info.json")
    check_stream(replicacad_stream(folder), clouds, POSES)


def test_sequences_of_nice_slam(tmp_path):
    folder = write_replicacad(tmp_path / "room0")
    info = json.loads((folder / "replicaCAD_info.json").read_text())
    (folder / "replicaCAD_info.json").unlink()
    info["camera"]["scale"] = 6553.5
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": info["camera"]}))
    check_stream(open_stream(folder), [backproject(raw, 6553.5) for raw in RAW], POSES)


def test_sequences_without_poses(tmp_path):
    folder = write_replicacad(tmp_path)
    (folder / "traj.txt").unlink()
    with pytest.raises(NoPosesError, match=r"has no poses, expected them in traj\.txt"):
        replicacad_stream(folder)
    stream = open_stream(folder, "replicacad", poses=False)  # "results" alone says little
    check_stream(stream, [backproject(raw, 3276.75) for raw in RAW], IDENTITIES)


def test_bad_frames(tmp_path):
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
    check_bad(open_stream(folder), 2, image, "expected one 16-bit channel")
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
def test_bad_files(tmp_path, name, edit, message):
    folder = write_replicacad(tmp_path)
    (folder / name).write_text(edit)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        open_stream(folder)
    assert str(error.value).startswith(str(folder))


def test_camera_values_out_of_range(tmp_path):
    path = write_replicacad(tmp_path) / "replicaCAD_info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {"depth_scale": 0}))
    with pytest.raises(ValueError, match=r"info\.json: depth scale is 0\.0, expected > 0"):
        open_stream(tmp_path)
    path.write_text(json.dumps(info | {"camera": info["camera"] | {"fx": -1}}))
    with pytest.raises(ValueError, match=r"info\.json: camera .* is \[\[-1\.0, .*expected focal"):
        open_stream(tmp_path)
    for width in ("1e400", "NaN", '"7"', "[7]", "[" * 3000):
        path.write_text(json.dumps(info).replace('"w": 7', f'"w": {width}'))
        with pytest.raises(ValueError, match=r"replicaCAD_info\.json: "):
            read_frame(open_stream(tmp_path), 0)
    path.unlink()
    with pytest.raises(ValueError, match="neither it nor its parent folder has one of"):
        open_stream(tmp_path)
