"""Tiny recordings of four frames, and the checks that every reader of them must pass."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from hiosdf_jax.datasets import BadFrameError, find_bounds, read_frame

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
IDENTITIES = np.tile(np.eye(4), (FRAMES, 1, 1))  # poses that are not read


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
    """The pinhole model, pixel by pixel."""
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
    """One frame is bad, and its message gives the reason; the other frames are usable."""
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


def quaternions(poses):
    return Rotation.from_matrix(np.asarray(poses)[:, :3, :3]).as_quat()


def write_scannet(folder):
    for i, n in enumerate([0, 2, 9, 10]):  # some frames are missing, and 10 comes after 9
        write_png(folder / "depth" / f"{n}.png", RAW[i])
        write_text(folder / "pose" / f"{n}.txt", *POSES[i])
    matrix = np.eye(4)
    matrix[0, 0], matrix[1, 1], matrix[:2, 2] = FX, FY, [CX, CY]
    write_text(folder / "intrinsic" / "intrinsic_depth.txt", *matrix)
    return folder


def write_tum(folder, raw=RAW):
    stamps = 1305031453.3741 + 0.03 * np.arange(len(raw))
    names = [f"depth/{stamp:.6f}.png" for stamp in stamps]
    for name, image in zip(names, raw, strict=True):
        write_png(folder / name, image)
    rows = [("#", "depth", "maps"), *zip((f"{s:.6f}" for s in stamps), names, strict=True)]
    write_text(folder / "depth.txt", *rows)
    # Two poses around each image: their middle is the pose of the image.
    rows = []
    for stamp, pose, quaternion in zip(stamps, POSES, quaternions(POSES), strict=False):
        step = np.array([0.2, -0.1, 0.3])
        rows.append([f"{stamp - 0.004:.6f}", *(pose[:3, 3] - step), *quaternion])
        rows.append([f"{stamp + 0.004:.6f}", *(pose[:3, 3] + step), *-quaternion])
    write_text(folder / "groundtruth.txt", ["#", "timestamp"], *rows)
    return folder
