"""Maps streams whose poses drift, jump or are missing, and finds frames in a finished map.

    python -m benchmarks.tracking --stream ../shared/data/house_depth.npz --poses jitter
    python -m benchmarks.tracking --stream ../shared/data/hall_lidar.npz --poses none --kiss-icp
    python -m benchmarks.tracking --stream demo --frames 240 --poses exact drift none --kiss-icp
    python -m benchmarks.tracking --stream ../shared/data/house_depth.npz --relocalize 100
    python -m benchmarks.tracking --stream house_depth.npz --relocalize 30 --mapped 60
    python -m benchmarks.tracking --stream ../shared/data/hall_lidar.npz --wrong-poses
    python -m benchmarks.tracking --stream house_depth.npz --foreign kitchen_depth.npz

`--poses` says what is done to the stream's poses before they are refined:

- `exact`, `jitter unrefined`: nothing, or as below; the poses are not refined
- `jitter`: each is off by 2 cm and 1 degree, in random directions
- `jitter known`: the same, and each is a prior with that standard deviation
- `jitter smoothed`: the same, smoothed afterwards with that deviation, and mapped again three times
- `glitch`, `glitch left out`: five of them are off by 1 m, or those frames are missing
- `drift`, `drift unrefined`: odometry that is too long by 1 % and turns by 0.05 degrees per meter
- `drift known`: the same, and what they predict is a prior. Its standard deviations per axis are
  1 % of the distance traveled and 0.2 degrees per meter
- `none`: only the first is used

`--relocalize` searches random frames. `--mapped` maps only the first ones, and searches the others:
some of them are at places that the map does not know. `--map` takes a saved map, for instance of
another place. It counts right places, wrong ones that have converged, and how many are `sure`.

`--wrong-poses` refines each third frame in the map before it, from poses that are 1 and 0.5 m off
along the floor, and 0.1 and 0.2 m along z.
`--foreign` tracks the frames of another recording in the map of the whole stream, each at a random
pose of the stream. Given the stream itself, the pose is at least 1 m from the frame's own.

`--stream demo` is the apartment; 240 frames are 10 Hz at 1 m/s. `--kiss-icp` measures the odometry
of KISS-ICP on the same clouds beside; it needs `pip install kiss-icp`. `--output` writes a record
of the figures, and `--gate` compares them with the committed one.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks import pose_record
from benchmarks.registration import error, normalized_square, perturb
from hiosdf_jax import datasets, demo, scoring
from hiosdf_jax._src.command.stream_poses import Tracker
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.mapping.registration.comparing import GROWING_REACH_M
from hiosdf_jax._src.mapping.registration.judging import LEAST_INLIERS
from hiosdf_jax._src.mapping.tracking import is_near, prior_of_prediction

MODES = (
    "exact",
    "jitter unrefined",
    "jitter",
    "jitter known",
    "jitter smoothed",
    "glitch",
    "glitch left out",
    "drift unrefined",
    "drift",
    "drift known",
    "none",
)
DRIFT = 0.01, 0.05  # of the distance traveled, degrees per meter
KNOWN_DRIFT = 0.01, 0.2  # standard deviations per axis: of the distance, degrees per meter
JITTER = 0.02, 1.0  # m, degrees
JITTER_COVARIANCE = np.diag(np.repeat([JITTER[0], np.radians(JITTER[1])], 3) ** 2 / 3)
MAPPED_AGAIN = 3
GLITCH = range(60, 65)

# Shifts of the right pose, m, and how far from it a result is wrong, m. A wrong one is sure if it
# is off by more than this many of its standard deviations.
WRONG_POSES = {
    "1 m off": (((0.6, 0.8, 0), (-0.6, -0.8, 0), (0.8, -0.6, 0), (-0.8, 0.6, 0)), 0.3),
    "0.5 m off": (((0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0)), 0.3),
    "0.1 m along z": (((0, 0, 0.1), (0, 0, -0.1)), 0.05),
    "0.2 m along z": (((0, 0, 0.2), (0, 0, -0.2)), 0.05),
}
SURE_DEVIATIONS = 5

FOREIGN_FROM_M = 1.0

# A frame counts as found within this, m and degrees.
FOUND = 0.05, 1.0


def change(exact, mode, seed=0):
    """Returns the poses that a stream has, made worse."""
    given = [np.array(pose) for pose in exact]
    if mode.startswith("jitter"):
        rng = np.random.default_rng(seed)
        given[1:] = [perturb(pose, rng, *JITTER) for pose in exact[1:]]
    if mode == "glitch":
        for i in GLITCH:
            given[i][:3, 3] += [0.6, 0.8, 0]
    if mode.startswith("drift"):
        for i in range(1, len(exact)):
            step = np.linalg.inv(exact[i - 1]) @ exact[i]
            turn = np.radians(DRIFT[1]) * np.linalg.norm(step[:3, 3])
            step[:3, 3] *= 1 + DRIFT[0]
            given[i] = given[i - 1] @ step
            given[i][:3, :3] = Rotation.from_euler("z", turn).as_matrix() @ given[i][:3, :3]
    return given


def map_stream(frames, config, mode, seed=0):
    """Maps frames; returns the map, the poses at which they were fused, and who was refused."""
    given = change([pose for _, pose in frames], mode, seed)
    tracker = Tracker(mode == "none", KNOWN_DRIFT if mode == "drift known" else None)
    state = hio.init(config, jax.random.key(0))
    poses, refused = [], []
    for i, (cloud, _) in enumerate(frames):
        pose, registered = given[i], True
        if mode == "glitch left out" and i in GLITCH:
            poses.append(pose)
            continue
        if mode == "exact" or mode.endswith("unrefined"):
            state = hio.update(state, cloud, pose)
        elif mode.startswith("jitter"):
            known = (pose, JITTER_COVARIANCE) if mode == "jitter known" else None
            state, found = hio.track(state, cloud, pose, known)
            pose, registered = found.pose, bool(found.converged)
        else:
            state, pose = tracker.fuse(state, cloud, pose, i)
            registered = tracker.frames[-1].registered
        poses.append(np.asarray(pose))
        if not registered:
            refused.append(i)
    if mode == "jitter smoothed":
        state, poses, refused = map_again(frames, config, given, poses, refused)
    return state, poses, refused


def map_again(frames, config, given, poses, refused):
    """Maps registered frames at smoothed poses, and registers all in that map.

    Returns the map, the poses, and who was refused last.
    """
    registered = ~np.isin(np.arange(len(frames)), refused)
    for rounds_left in reversed(range(MAPPED_AGAIN)):
        poses = hio.smooth_poses(poses, given, JITTER_COVARIANCE, registered)
        state = hio.init(config, jax.random.key(0))
        for (cloud, _), pose, is_registered in zip(frames, poses, registered, strict=True):
            if is_registered:
                state = hio.update(state, cloud, pose)
        if rounds_left:
            found = [
                hio.refine_pose(state, cloud, pose)
                for (cloud, _), pose in zip(frames, poses, strict=True)
            ]
            poses = [np.asarray(each.pose) for each in found]
            registered = np.array([bool(each.converged) for each in found])
    return state, list(poses), np.flatnonzero(~registered).tolist()


def measure_poses(poses, frames):
    """Returns how far poses are from the exact ones, which they share at the first frame."""
    away = np.stack([error(a, b) for a, (_, b) in zip(poses, frames, strict=True)])
    distance_cm = 100 * np.linalg.norm(away[:, :3], axis=1)
    return {
        "rms_cm": np.sqrt(np.mean(distance_cm**2)),
        "most_cm": distance_cm.max(),
        "end_cm": distance_cm[-1],
        "end_deg": np.degrees(np.linalg.norm(away[-1, 3:])),
    }


def measure_kiss_icp(frames, max_range):
    """Returns the errors of KISS-ICP with its defaults for this range, without deskewing."""
    from kiss_icp.config import KISSConfig  # pyright: ignore[reportMissingImports]
    from kiss_icp.kiss_icp import KissICP  # pyright: ignore[reportMissingImports]

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = max_range, 0.0, False
    config.mapping.voxel_size = max_range / 100
    odometry, poses = KissICP(config), []
    for cloud, _ in frames:
        points = np.asarray(cloud[np.isfinite(cloud).all(axis=1)], np.float64)
        odometry.register_frame(points, np.zeros(len(points)))
        poses.append(frames[0][1] @ odometry.last_pose)
    return measure_poses(poses, frames)


def measure_tracking(frames, config, truth, mode, seed):
    """Maps a stream; returns the errors of the poses and of the map."""
    state, poses, refused = map_stream(frames, config, mode, seed)
    row = measure_poses(poses, frames) | {"frames": len(frames), "not_registered": len(refused)}
    if mode == "glitch":
        row["fused_wrong"] = len(set(GLITCH) - set(refused))
    if truth is not None:
        queries = CompiledQueries(hio.snapshot(state))
        scores = scoring.evaluate(queries.sdf_and_grad, truth, last_frame=len(frames) - 1)
        row["map_cm"] = scores["visible_cm"]
    return row


def measure_wrong_poses(frames, config):
    """Counts wrong poses that pass as right ones, and right ones that are refused."""
    state = hio.init(config, jax.random.key(0))
    right = {"tried": 0, "refused": 0}
    wrong = {
        label: {"tried": 0, "enough_inliers": 0, "taken": 0, "wrong_sure": 0, "most_taken_m": 0.0}
        for label in WRONG_POSES
    }
    for i, (cloud, pose) in enumerate(tqdm(frames, "mapping", leave=False)):
        if i >= 6 and i % 3 == 0:
            found, near = _refine_from(state, cloud, pose)
            right["tried"] += 1
            right["refused"] += not (near and bool(found.converged))
            for label, (shifts, wrong_m) in WRONG_POSES.items():
                for shift in shifts:
                    _try_wrong_pose(state, cloud, pose, shift, wrong_m, wrong[label])
        state = hio.update(state, cloud, pose)
    return {"right": right} | wrong


def _try_wrong_pose(state, cloud, pose, shift, wrong_m, row):
    """Refines a pose from a shifted one, and adds what comes of it to the counts of a row."""
    start = np.array(pose)
    start[:3, 3] += shift
    found, near = _refine_from(state, cloud, start)
    away = error(found.pose, pose)[:3]
    away_m = np.linalg.norm(away)
    near &= away_m >= wrong_m
    row["tried"] += 1
    row["enough_inliers"] += near and float(found.inliers) >= LEAST_INLIERS
    if near and bool(found.converged):
        square = normalized_square(away, found.covariance[:3, :3])
        row["taken"] += 1
        row["wrong_sure"] += square > SURE_DEVIATIONS**2
        row["most_taken_m"] = max(row["most_taken_m"], away_m)


def _refine_from(state, cloud, start):
    """Refines a pose as `track` does; returns it, and whether it is as near as `track` demands."""
    prior = prior_of_prediction(start, GROWING_REACH_M)
    found = hio.refine_pose(state, cloud, start, prior, reach_m=GROWING_REACH_M)
    return found, bool(is_near(start, found.pose, GROWING_REACH_M))


def measure_foreign(frames, config, others):
    """Counts frames of another place that `track` takes, in the map of a whole stream."""
    state, _, _ = map_stream(frames, config, "exact")
    rng, row = np.random.default_rng(0), {"tried": 0, "taken": 0}
    for cloud, pose in tqdm(others, "tracking", leave=False):
        wrong = [at for _, at in frames if np.linalg.norm((at - pose)[:3, 3]) >= FOREIGN_FROM_M]
        _, found = hio.track(state, cloud, wrong[rng.integers(len(wrong))])
        row["tried"] += 1
        row["taken"] += bool(found.converged)
    return row


def measure_relocalization(frames, numbers, field, up_world):
    """Finds frames in a map; counts right, wrong and sure places; also the median time, s."""
    rng, seconds, places = np.random.default_rng(0), [], []
    for i in tqdm(numbers, "relocalizing", leave=False):
        cloud, pose = frames[i]
        # An accelerometer that is off by a degree.
        tilt = perturb(np.eye(4), rng, 0.0, 1.0)[:3, :3]
        up_sensor = tilt @ pose[:3, :3].T @ up_world
        begin = time.perf_counter()
        place = hio.relocalize(
            field, cloud, jax.random.key(i), up_sensor=up_sensor, up_world=up_world
        )
        jax.block_until_ready(place)
        seconds.append(time.perf_counter() - begin)
        away = error(place.best.pose, pose)
        distance_m, angle = np.linalg.norm(away[:3]), np.degrees(np.linalg.norm(away[3:]))
        right = distance_m < FOUND[0] and angle < FOUND[1]
        places.append([right, bool(place.best.converged), bool(place.sure)])
        if not right:
            scores = f"score {float(place.score):.2f}, other {float(place.other_score):.2f}"
            print(f"frame {i}: {distance_m:.2f} m and {angle:.1f} deg off, {scores}")
    places = np.array(places)
    right, wrong = places[places[:, 0]], places[~places[:, 0]]
    return {
        "tried": len(places),
        "found": len(right),
        "sure": right[:, 2].sum(),
        "wrong": len(wrong),
        "wrong_converged": wrong[:, 1].sum(),
        "wrong_sure": wrong[:, 2].sum(),
    }, np.median(seconds[1:])


def print_row(stream, name, row):
    """Prints the figures of a row on one line."""
    figures = ", ".join(f"{figure} {float(value):.4g}" for figure, value in row.items())
    print(f"{stream}, {name}: {figures}", flush=True)


def main():
    parser = argparse.ArgumentParser(description="Tracks streams and relocalizes frames.")
    parser.add_argument("--stream", type=Path, required=True, help="a recording, or demo")
    parser.add_argument("--poses", choices=MODES, nargs="*", default=[], help="see above")
    parser.add_argument("--seed", type=int, default=0, help="of the jitter")
    parser.add_argument("--order", type=int, default=0, help="seed to shuffle the clouds' rows by")
    parser.add_argument("--relocalize", type=int, default=0, help="frames to find")
    parser.add_argument("--mapped", type=int, help="map this many frames and find others")
    parser.add_argument("--map", type=Path, help="the map to find them in; made by default")
    parser.add_argument("--wrong-poses", action="store_true", help="see above")
    parser.add_argument("--foreign", type=Path, help="a recording, of another place")
    parser.add_argument(
        "--frames", type=int, help="use only the first ones; the demo has this many"
    )
    parser.add_argument("--kiss-icp", action="store_true", help="measure KISS-ICP, too")
    pose_record.add_options(parser)
    arguments = parser.parse_args()
    if is_demo := str(arguments.stream) == "demo":
        stream = demo.ApartmentStream(arguments.frames or 240)
        bounds, max_range = demo.BOUNDS_WORLD, stream.max_range
        truth = demo.sample_truth(stream)
    else:
        stream = datasets.open_stream(arguments.stream)
        bounds, max_range = datasets.find_bounds(stream)
        truth = datasets.read_truth(arguments.stream)
    config = hio.Config.light(bounds, max_range=max_range)
    frames = [stream[i] for i in range(arguments.frames or len(stream))]
    if arguments.order:
        order = np.random.default_rng(arguments.order)
        frames = [(order.permutation(cloud), pose) for cloud, pose in frames]
    name, worse = arguments.stream.stem, 0
    if arguments.frames and not (is_demo and arguments.frames == 240):
        name += f", {arguments.frames} frames"
    if arguments.order:
        name += f", order {arguments.order}"
    tracked = {}
    for mode in arguments.poses:
        label = f"{mode}, seed {arguments.seed}" if mode.startswith("jitter") else mode
        tracked[label] = measure_tracking(frames, config, truth, mode, arguments.seed)
        print_row(name, label, tracked[label])
    if arguments.kiss_icp:
        tracked["KISS-ICP"] = measure_kiss_icp(frames, max_range)
        print_row(name, "KISS-ICP", tracked["KISS-ICP"])
    worse += pose_record.finish(arguments, "tracking", name, tracked)
    if arguments.wrong_poses:
        rows = measure_wrong_poses(frames, config)
        for label, row in rows.items():
            print_row(name, label, row)
        worse += pose_record.finish(arguments, "wrong poses", name, rows)
    if arguments.foreign:
        row = measure_foreign(frames, config, datasets.open_stream(arguments.foreign))
        label = f"frames of {arguments.foreign.stem}"
        print_row(name, label, row)
        worse += pose_record.finish(arguments, "foreign frames", name, {label: row})
    if arguments.relocalize:
        if arguments.map:
            state = hio.load(arguments.map)
        else:
            state = map_stream(frames[: arguments.mapped], config, "exact")[0]
        up_world = np.array([0, 0, 1.0])
        if not is_demo:
            with np.load(arguments.stream) as file:
                up_world = file.get("floor_normal", up_world)
                if arguments.map and "floor_normal" in file:
                    parser.error("--map needs a stream whose z axis is up")
        up_world = up_world * np.sign(up_world[2]) / np.linalg.norm(up_world)
        first = arguments.mapped or 0
        others = first + np.random.default_rng(0).permutation(len(frames) - first)
        numbers = others[: arguments.relocalize].tolist()
        row, seconds = measure_relocalization(frames, numbers, hio.snapshot(state), up_world)
        print(f"{name}: {seconds:.2f} s per frame (median)")
        where = "its own map"
        if arguments.map:
            where = f"the map {arguments.map.stem}"
        elif arguments.mapped:
            where = f"the map of {arguments.mapped} frames"
        where = f"{len(numbers)} in {where}"
        print_row(name, where, row)
        worse += pose_record.finish(arguments, "places", name, {where: row})
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
