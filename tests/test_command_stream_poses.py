"""Runs of the command that refine the poses of a stream, or use none of them."""

import json
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from room import CONFIG, room_cloud
from room_files import BOX, use_room_config
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax._src.change.consistency import CONFIDENT_UPDATES
from hiosdf_jax._src.command import cli, map_stream, stream_poses
from hiosdf_jax._src.command.inputs import find_bounds_around_start
from hiosdf_jax._src.command.stream_poses import TRAJECTORY, Tracker, continued, without_flips
from hiosdf_jax._src.datasets.stream import BadFrameError, FrameStream
from hiosdf_jax._src.datasets.timed_poses import pose_at, read_timed_poses
from hiosdf_jax._src.mapping.registration.refining import Registration

FRAMES = 15
STILL = 7  # frames before the sensor moves: the small clouds of one make no map


@pytest.fixture
def quick(monkeypatch):
    """The small map of the other tests, and no pictures of it."""
    use_room_config(monkeypatch)
    monkeypatch.setattr(map_stream.drawing, "draw_map", lambda *_: np.array([0.0, 0, 1]))


def walk():
    """Clouds (F, N, 3) along a slow walk, and the exact poses (F, 4, 4)."""
    steps = np.maximum(np.arange(FRAMES) - STILL, 0)
    frames = [
        room_cloud(i, 300, 0.02 * k, (0.015 * k - 0.1, 0.01 * k, 0.0)) for i, k in enumerate(steps)
    ]
    return (np.stack(part) for part in zip(*frames, strict=True))


def write(path, clouds, **arrays):
    np.savez(
        path,
        **arrays,
        points_mm=np.rint(1000 * clouds.reshape(-1, 3)).astype(np.int16),
        offsets=clouds.shape[1] * np.arange(len(clouds) + 1),
    )
    return str(path)


def write_folder(folder, clouds, names):
    folder.mkdir()
    for cloud, name in zip(clouds, names, strict=True):
        trimesh.PointCloud(cloud).export(folder / f"{name}.ply")
    return str(folder)


def from_first(poses):
    """Poses (F, 4, 4) in the frame of the first one."""
    return np.linalg.inv(poses[0]) @ poses


def drifting(poses):
    """Poses whose error grows by 1 cm and half a degree a frame, to 7 cm and 3.5 degrees."""
    result = poses.astype(float)
    for i, pose in enumerate(result):
        k = max(i - STILL, 0)
        pose[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(0.5 * k)]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += [0.01 * k, 0, 0]
    return result


def test_quaternions_of_a_trajectory_have_no_flips():
    """A sensor that turns twice about itself."""
    angles = np.linspace(0, 4 * np.pi, 50)
    exact = np.stack([0 * angles, 0 * angles, np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    flipped = exact * np.random.default_rng(0).choice([-1, 1], (50, 1))
    found = without_flips(flipped)
    np.testing.assert_allclose(found * np.sign(found[0] @ exact[0]), exact)
    assert without_flips(exact[:1]).shape == (1, 4)


def way_cm(poses, exact):
    return 100 * np.linalg.norm(poses[:, :3, 3] - exact[:, :3, 3], axis=-1)


@pytest.mark.parametrize(
    "options",
    [["--refine-poses"], ["--refine-poses", "--drift", "0.5", "30"], ["--odometry"]],
    ids=" ".join,
)
def test_a_trajectory_is_refined_and_written(tmp_path, quick, capsys, options):
    clouds, exact = walk()
    given = drifting(exact)
    stream = write(tmp_path / "walk.npz", clouds, poses=given)
    output, saved = tmp_path / "out", tmp_path / "map.npz"
    arguments = ["map", stream, *options, "--output", str(output), "--save", str(saved), *BOX]
    assert cli.main(arguments) == 0
    assert {path.name for path in output.iterdir()} == {*TRAJECTORY, "metrics.json"}
    with np.load(output / "trajectory.npz") as file:
        poses, covariance, registered = file["poses"], file["covariance"], file["registered"]
        np.testing.assert_array_equal(file["frame"], np.arange(FRAMES))
        np.testing.assert_array_equal(file["time"], np.arange(FRAMES))
    assert registered[0]
    assert registered[CONFIDENT_UPDATES:].all()
    assert way_cm(given, exact).max() > 6.9
    assert way_cm(poses, exact).max() < 3
    assert covariance.shape == (FRAMES, 6, 6)
    assert (output / "trajectory.txt").read_text().startswith("# frame ")  # the reader looks for it
    text = read_timed_poses(output / "trajectory.txt")
    for i in range(FRAMES):
        np.testing.assert_allclose(pose_at(text, i, 0.1), poses[i], atol=1e-5)
    assert imread(output / "trajectory.png").std() > 0.05
    metrics = json.loads((output / "metrics.json").read_text("utf-8"))
    names = "frames_registered", "frames_as_predicted", "frames_not_registered", "lost_since"
    trusted = int((~registered).sum())
    assert [metrics[name] for name in names] == [FRAMES - trusted, trusted, 0, None]
    assert f"{FRAMES - trusted} frames were registered, 0 were not" in capsys.readouterr().out
    # The map has no poses, from which a run could continue.
    plain = ["map", stream, "--output", str(output), "--resume", str(saved), *BOX]
    assert cli.main(plain) == 2
    assert "does not say how far the map has come" in capsys.readouterr().err


def test_a_file_without_poses_is_mapped_by_odometry(tmp_path, quick):
    clouds, exact = walk()
    stamps = 1.7e9 + 0.1 * np.arange(FRAMES) ** 1.1
    stream, output = write(tmp_path / "walk.npz", clouds, stamp=stamps), tmp_path / "out"
    arguments = ["map", stream, "--odometry", "--output", str(output), *BOX]
    assert cli.main([*arguments, "--frames", "14"]) == 0
    with np.load(output / "trajectory.npz") as file:
        assert way_cm(file["poses"], from_first(exact)[:14]).max() < 3
        np.testing.assert_array_equal(file["poses"][0], np.eye(4))
        np.testing.assert_array_equal(file["time"], stamps[:14])
    text = output / "trajectory.txt"
    np.testing.assert_allclose(read_timed_poses(text).stamps, stamps[:14], rtol=1e-15)
    assert text.read_text().startswith("# time tx")
    assert imread(output / "trajectory.png").std() > 0.05


def test_a_folder_of_clouds_without_poses_is_mapped_by_odometry(
    tmp_path, quick, capsys, monkeypatch
):
    """Neither poses nor bounds; the names are the times, in nanoseconds."""
    clouds, exact = walk()
    boxes = []

    def light(cls, bounds, **_):
        boxes.append(bounds)
        return CONFIG  # compiled already

    monkeypatch.setattr(hio.Config, "light", classmethod(light))
    names = 1_700_000_000_000_000_000 + 123_456_789 * np.arange(FRAMES)
    stream, output = write_folder(tmp_path / "scans", clouds, names), tmp_path / "out"
    assert cli.main(["map", stream, "--odometry", "--output", str(output)]) == 0
    text = capsys.readouterr().out
    assert "mapping 3 m around what the sensor sees from its first position (--bounds sets" in text
    timed = read_timed_poses(output / "trajectory.txt")
    np.testing.assert_allclose(timed.stamps, 1e-9 * names, rtol=0, atol=1e-6)
    found = np.stack([pose_at(timed, stamp, 0.1) for stamp in timed.stamps])
    assert way_cm(found, from_first(exact)).max() < 3
    metrics = json.loads((output / "metrics.json").read_text("utf-8"))
    assert (metrics["updates"], metrics["flags"]) == (FRAMES, ["FUSED_AS_PREDICTED"])
    low, high = np.array(boxes[-1])
    seen = np.concatenate(clouds)  # walls at 0.97, 0.78 and 0.56 m
    np.testing.assert_allclose(low, seen.min(axis=0) - 3, atol=0.1)
    np.testing.assert_allclose(high, seen.max(axis=0) + 3, atol=0.1)


@pytest.mark.parametrize("options", [[], ["--refine-poses"]], ids=str)
@pytest.mark.parametrize("kind", ["npz", "clouds"])
def test_a_stream_without_poses_needs_odometry(tmp_path, capsys, kind, options):
    clouds = [np.ones((4, 3))] * 2
    if kind == "npz":
        stream = write(tmp_path / "walk.npz", np.stack(clouds))
    else:
        stream = write_folder(tmp_path / "scans", clouds, range(2))
    arguments = ["map", stream, *options, "--output", str(tmp_path / "out"), *BOX]
    assert cli.main(arguments) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"hiosdf: {stream}: has no poses, expected ")
    assert last.endswith("; --odometry maps a stream without poses")


def test_exact_distances_need_poses(tmp_path, capsys):
    stream, scene = write(tmp_path / "walk.npz", np.ones((2, 4, 3))), tmp_path / "scene.ply"
    trimesh.creation.box().export(scene)
    arguments = ["map", stream, "--odometry", "--ground-truth", str(scene), *BOX]
    assert cli.main([*arguments, "--output", str(tmp_path / "out")]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"hiosdf: {stream}: has no poses")
    assert last.endswith(": --ground-truth needs poses")


def test_bounds_do_not_come_from_poses_that_odometry_ignores():
    """A LiDAR that is turned by 90 degrees, and a camera; poses after the first are far off."""
    pose, lost = np.eye(4), np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose[:3, 3] = [10, 20, 1]
    lost[:3, 3] = 500
    rng = np.random.default_rng(0)
    around = rng.uniform([-6, -4, -1], [6, 4, 2], (5000, 3)).astype(np.float32)
    frames = [(around, pose), (around, lost)]
    found = find_bounds_around_start(FrameStream("lidar", 2, frames.__getitem__))
    np.testing.assert_allclose(found.bounds, [[3, 11, -3], [17, 29, 6]], atol=0.1)
    assert 6.5 < found.max_range < 7.5
    ahead = rng.uniform([-1, -1, 1], [1, 1, 5], (5000, 3)).astype(np.float32)
    frames = [(np.full((9, 3), np.nan), lost), (ahead, pose), (ahead, lost)]
    camera = FrameStream("camera", 3, frames.__getitem__)
    with pytest.raises(BadFrameError, match=r"^frame 0: cloud has no finite row"):
        find_bounds_around_start(camera)
    found = find_bounds_around_start(camera, skip_bad_frames=True)
    np.testing.assert_allclose(found.bounds, [[2, 12, -7], [18, 28, 9]], atol=0.1)


def screw(seconds):
    """The pose of a sensor that drives on a helix."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZX", [0.3 * seconds, 0.2]).as_matrix()
    pose[:3, 3] = [2 * np.sin(0.3 * seconds), -2 * np.cos(0.3 * seconds), 0.1 * seconds]
    return pose


@pytest.mark.parametrize("ahead", [0.5, 1, 2.3, 4])
def test_a_motion_is_continued_for_as_long_as_the_next_frame_needs(ahead):
    found = continued(screw(1), screw(1.2), ahead)
    expected = screw(1.2 + 0.2 * ahead)
    np.testing.assert_allclose(found[:3, :3], expected[:3, :3], atol=1e-5)
    np.testing.assert_allclose(found[:3, 3], expected[:3, 3], atol=1e-3)  # of 0.5 m


@pytest.mark.parametrize(
    ("stamps", "seconds"),
    [
        (None, 0.5),  # frames 3 and 4 are missing
        ([0, 0.1, 0.2, 0.3, 0.4, 0.7], 0.7),
        ([0, 0.1, 0.2, 0.3, 0.4, 9], 0.7),  # five times the last motion at most
        ([0, 0.2, 0.1, 0.3, 0.4, 0.7], 0.5),  # no times: they decrease
        ([0, 0.1, 0.2, 0.3, 0.4, np.nan], 0.5),
    ],
)
def test_the_velocity_is_kept_over_missing_frames(stamps, seconds):
    tracked = Tracker(odometry=True, stamps=None if stamps is None else np.array(stamps, float))
    for frame in (1, 2):
        pose = screw(0.1 * frame)
        found = Registration(pose, np.eye(6), 0.0, 0.0, True)
        tracked._add(frame, np.eye(4), found, True)
    np.testing.assert_allclose(tracked.predict(np.eye(4), 5), screw(seconds), atol=1e-3)


def test_frames_that_do_not_fit_do_not_change_the_velocity():
    tracked = Tracker(odometry=True, stamps=np.array([0.1, 0.2, 2.2, 2.3]))
    zero = np.float32(0)
    for frame in (0, 1):
        found = Registration(screw(0.1 * frame), np.eye(6), zero, zero, np.asarray(True))
        tracked._add(frame, np.eye(4), found, True)
    missed = found._replace(pose=tracked.predict(np.eye(4), 2), converged=np.asarray(False))
    tracked._add(2, np.eye(4), missed, False)
    # Five times as long as the velocity was measured, from the last frame that fits.
    np.testing.assert_allclose(tracked.predict(np.eye(4), 3), screw(0.1 + 0.5), atol=1e-3)


def test_a_held_out_frame_that_does_not_fit_has_the_covariance_of_its_prediction(monkeypatch):
    zero = jnp.float32(0)
    wrong = Registration(jnp.eye(4), 1e-8 * jnp.eye(6), zero, zero, jnp.asarray(False))
    monkeypatch.setattr(stream_poses, "refine_pose", lambda *_, **__: wrong)
    tracked: Any = Tracker(odometry=False)
    tracked.locate(None, None, np.eye(4), 0)
    assert np.sqrt(np.diag(tracked.frames[0].covariance)).min() > 0.01


def test_a_stream_that_is_lost_says_since_when(tmp_path, quick, capsys):
    clouds, exact = walk()
    for i in (7, *range(10, FRAMES)):
        clouds[i] = np.random.default_rng(i).normal(size=clouds[i].shape)
    stream, output = write(tmp_path / "walk.npz", clouds, poses=exact), tmp_path / "out"
    assert cli.main(["map", stream, "--refine-poses", "--output", str(output), *BOX]) == 0
    metrics = json.loads((output / "metrics.json").read_text("utf-8"))
    assert (metrics["frames_not_registered"], metrics["lost_since"]) == (FRAMES - 9, 10)
    assert "lost since frame 10: frames must overlap" in capsys.readouterr().out


def test_a_frame_of_another_place_is_left_out(tmp_path, quick):
    clouds, exact = walk()
    clouds[12] = np.random.default_rng(0).normal(size=clouds[14].shape)
    stream = write(tmp_path / "walk.npz", clouds, poses=exact)
    output = tmp_path / "out"
    assert cli.main(["map", stream, "--refine-poses", "--output", str(output), *BOX]) == 0
    with np.load(output / "trajectory.npz") as file:
        late = file["registered"][CONFIDENT_UPDATES:]
        assert list(CONFIDENT_UPDATES + np.flatnonzero(~late)) == [12]
        assert way_cm(file["poses"], exact).max() < 3
    metrics = json.loads((output / "metrics.json").read_text("utf-8"))
    assert metrics["updates"] == FRAMES - 1
    assert metrics["flags"] == ["NOT_REGISTERED", "FUSED_AS_PREDICTED"]


@pytest.mark.parametrize("option", ["--refine-poses", "--odometry"])
def test_such_a_run_cannot_be_resumed(tmp_path, capsys, option):
    assert cli.main(["map", str(tmp_path / "a.npz"), option, "--resume", "map.npz"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"hiosdf: --resume cannot be combined with {option}: maps have no poses"


def test_the_prior_of_a_drift_grows_with_the_way(monkeypatch):
    """Frames that turn, and are 0, 2 cm and 0.5 m from the one before."""
    priors = []

    def note(state, cloud, predicted, prior):
        priors.append(prior)
        zero = jnp.float32(0)
        found = Registration(predicted, jnp.eye(6), zero, zero, jnp.asarray(True))
        return SimpleNamespace(updates=state.updates + 1), found

    monkeypatch.setattr(stream_poses, "track", note)
    tracked: Any = stream_poses.Tracker(odometry=False, drift=(0.01, 0.2))
    given = np.stack([np.eye(4)] * 4)
    given[:, 0, 3] = [0, 0, 0.02, 0.52]
    given[3, :3, :3] = Rotation.from_euler("z", 0.3).as_matrix()
    for i, pose in enumerate(given):
        tracked.fuse(SimpleNamespace(updates=i), None, pose, i)
    assert priors[0] is None
    for (mean, covariance), pose, way_m in zip(
        priors[1:], given[1:], (0.05, 0.05, 0.5), strict=True
    ):
        np.testing.assert_allclose(mean, pose, atol=1e-6)
        deviation = way_m * np.array([0.01] * 3 + [np.radians(0.2)] * 3)
        np.testing.assert_allclose(covariance, np.diag(deviation**2), rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--drift", "0.01", "0.2"], "--drift needs --refine-poses"),
        (["--odometry", "--drift", "0.01", "0.2"], "--drift needs --refine-poses"),
        *[
            (
                ["--refine-poses", "--drift", share, degrees],
                f"--drift is [{float(share)}, {float(degrees)}], "
                "expected a share of 0.0001 to 1 and 0.001 to 90 degrees per meter",
            )
            for share, degrees in [("0.01", "0"), ("nan", "1"), ("1e-30", "1"), ("1e30", "1e30")]
        ],
    ],
)
def test_a_drift_that_means_nothing_is_refused(tmp_path, capsys, options, message):
    assert cli.main(["map", str(tmp_path / "a.npz"), *options]) == 2
    assert capsys.readouterr().err == f"hiosdf: {message}\n"


def test_the_options_exclude_each_other(tmp_path, capsys):
    with pytest.raises(SystemExit) as error:
        cli.main(["map", str(tmp_path), "--refine-poses", "--odometry"])
    assert error.value.code == 2
    assert "not allowed with argument" in capsys.readouterr().err
