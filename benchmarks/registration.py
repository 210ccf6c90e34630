"""Refines perturbed poses of frames that a map was not given, and prints the errors that remain.

    python -m benchmarks.registration
    python -m benchmarks.registration --stream ../shared/data/house_depth.npz --tries 10
    python -m benchmarks.registration --stream ../shared/data/house_depth.npz --all
    python -m benchmarks.registration --between 200 --tries 1
    python -m benchmarks.registration --between 80 --tries 1 --occluded
    python -m benchmarks.registration --stream house_depth.npz --config default --hypotheses 4096

Without `--stream` the frames are those of the demo's camera. A tenth of them is held out. `--all`
makes ten maps, each without another tenth, so that almost every frame is held out once. `--between`
takes this many poses on the demo's path instead, almost all between the frames of the map.
`--occluded` puts a quarter of the returns at 0.55 of their range, as on a person, and the poses 10
cm and 4 degrees off. `--map` takes a saved map, made of all frames but the held-out ones, instead
of making it. `--bake` refines by a baked field. `--hypotheses` times this many poses at once, and
one pose inside `jit`. `--output` writes a record of the errors, and `--gate` compares them with the
committed one.
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks import pose_record
from hiosdf_jax import datasets, demo
from hiosdf_jax._src.scoring.held_out import held_out_frames

CASES = ((0.0, 0.0), (0.05, 3.0), (0.15, 6.0))  # m, degrees
OCCLUDED_CASE = 0.10, 4.0
OCCLUDED_SHARE, OCCLUDED_RANGE = 0.25, 0.55
FAR_CM = 3
DECIMALS = {
    "poses": 0,
    "median_cm": 2,
    "p95_cm": 2,
    "most_cm": 2,
    "median_deg": 3,
    "p95_deg": 3,
    "normalized_square": 1,
    "converged": 0,
    "far": 0,
    "far_converged": 0,
}
POINTS_OF_HYPOTHESES = 256
REPEATS = 20


def perturb(pose, rng, distance_m, angle_deg):
    """Moves a pose by a given distance and angle, in random directions."""
    direction, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    result = np.array(pose, float)
    turn = Rotation.from_rotvec(np.radians(angle_deg) * axis).as_matrix()
    result[:3, :3] = turn @ result[:3, :3]
    result[:3, 3] += distance_m * direction
    return result.astype(np.float32)


def error(pose, exact):
    """The motion from the exact pose, (6,) m and rad."""
    pose, exact = np.asarray(pose, float), np.asarray(exact, float)
    turn = Rotation.from_matrix(pose[:3, :3] @ exact[:3, :3].T).as_rotvec()
    return np.concatenate([pose[:3, 3] - exact[:3, 3], turn])


def normalized_square(away, covariance):
    """The square of an error (K,) in units of its standard deviations."""
    return away @ np.linalg.solve(np.asarray(covariance, float), away)


def occlude(cloud, rng):
    """Puts the returns of some columns of a camera's image nearer."""
    column = cloud[:, 0] / cloud[:, 2]
    begin = rng.uniform(0, 1 - OCCLUDED_SHARE)
    low, high = np.nanquantile(column, [begin, begin + OCCLUDED_SHARE])
    nearer = (column >= low) & (column < high)
    return np.where(nearer[:, None], OCCLUDED_RANGE * cloud, cloud)


def make_map(stream, held_out, config_name):
    """Maps all frames but some."""
    if isinstance(stream, demo.ApartmentStream):
        bounds, max_range = demo.BOUNDS_WORLD, stream.max_range
    else:
        bounds, max_range = datasets.find_bounds(stream)
    config = getattr(hio.Config, config_name)(bounds, max_range=max_range)
    state = hio.init(config, jax.random.key(0))
    for i in tqdm(range(len(stream)), "mapping", leave=False):
        if i not in held_out:
            state = hio.update(state, *stream[i])
    return state


def make_parts(stream, options):
    """Returns pairs of a map and the frames to find in it, as the options say."""
    parts = []
    first = held_out_frames(len(stream))
    for shift in range(first.step if options.all else 1):
        held_out = range(first.start + shift, len(stream), first.step)
        if options.map:
            state = hio.load(options.map)
        else:
            state = make_map(stream, held_out, options.config)
        field = hio.bake(state, options.bake) if options.bake else hio.snapshot(state)
        frames = [stream[i] for i in held_out]
        if options.between:
            dense = demo.ApartmentStream(options.between)
            frames = [dense[i] for i in range(len(dense))]
        parts.append((field, frames))
    if options.occluded:
        rng = np.random.default_rng(2)
        parts = [
            (field, [(occlude(cloud, rng), pose) for cloud, pose in frames])
            for field, frames in parts
        ]
    return parts


def measure_case(parts, distance_m, angle_deg, tries):
    """Refines perturbed poses; returns the figures of their errors, and the median time, ms.

    Args:
        parts: Pairs of a map and the frames that it was not given.
        distance_m: How far the poses are off.
        angle_deg: The same.
        tries: Poses per frame.
    """
    rng = np.random.default_rng(0)
    errors, squares, seconds, converged = [], [], [], []
    held_out = [(field, *frame) for field, frames in parts for frame in frames]
    for field, cloud, pose in held_out:
        for _ in range(tries if distance_m else 1):
            start = perturb(pose, rng, distance_m, angle_deg)
            begin = time.perf_counter()
            found = jax.block_until_ready(hio.refine_pose(field, cloud, start))
            seconds.append(time.perf_counter() - begin)
            away = error(found.pose, pose)
            errors.append([100 * np.linalg.norm(away[:3]), np.degrees(np.linalg.norm(away[3:]))])
            squares.append(normalized_square(away, found.covariance))
            converged.append(bool(found.converged))
    distance, angle = np.transpose(errors)
    far = distance > FAR_CM
    figures = {
        "poses": len(distance),
        "median_cm": np.median(distance),
        "p95_cm": np.percentile(distance, 95),
        "most_cm": distance.max(),
        "median_deg": np.median(angle),
        "p95_deg": np.percentile(angle, 95),
        "normalized_square": np.mean(squares),
        "converged": np.sum(converged),
        "far": np.sum(far),
        "far_converged": np.sum(far & converged),
    }
    return figures, 1e3 * np.median(seconds[1:])


def median_ms(function, arguments):
    """Measures how long a compiled function takes, ms."""
    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - begin)
    return 1e3 * np.median(seconds)


def print_hypotheses(field, frames, count):
    """Times refinements inside `jit`, and many poses of one frame at once by few returns."""
    rng = np.random.default_rng(0)
    distance_m, angle_deg = CASES[1]
    refine = jax.jit(hio.refine_pose)
    times = []
    for cloud, pose in frames:
        whole = jax.device_put(np.asarray(cloud, np.float32))
        times.append(median_ms(refine, (field, whole, perturb(pose, rng, distance_m, angle_deg))))
    print(f"one pose inside jit, median of {len(frames)} frames: {np.median(times):.2f} ms")
    cloud, pose = frames[0]
    starts = np.stack([perturb(pose, rng, distance_m, angle_deg) for _ in range(count)])
    returns = np.asarray(cloud, np.float32)[np.isfinite(cloud).all(axis=1)]
    few = returns[np.linspace(0, len(returns) - 1, POINTS_OF_HYPOTHESES).astype(int)]
    for most in (1, 5):
        refine = jax.vmap(partial(hio.refine_pose, starts=most), (None, None, 0))
        found = median_ms(jax.jit(refine), (field, few, starts))
        print(f"{count} poses, {len(few)} points, {most} starts: {found:.1f} ms", flush=True)


def main():
    parser = argparse.ArgumentParser(description="Refines perturbed poses.")
    parser.add_argument("--stream", type=Path, help="a recording; the demo's camera by default")
    parser.add_argument("--map", type=Path, help="a saved map without the held-out frames")
    parser.add_argument("--tries", type=int, default=10, help="perturbations per frame")
    parser.add_argument("--between", type=int, default=0, help="poses between the demo's frames")
    parser.add_argument("--all", action="store_true", help="hold out almost every frame once")
    parser.add_argument("--occluded", action="store_true", help="see above")
    parser.add_argument("--config", choices=("light", "default"), default="light")
    parser.add_argument("--bake", type=float, metavar="M", help="bake the map at this resolution")
    parser.add_argument("--hypotheses", type=int, default=0, help="poses to refine at once")
    pose_record.add_options(parser)
    arguments = parser.parse_args()
    if arguments.between and arguments.stream:
        parser.error("--between is for the demo, without --stream")
    if arguments.all and (arguments.between or arguments.map):
        parser.error("--all makes its own maps, and takes their frames")
    stream = (
        datasets.open_stream(arguments.stream) if arguments.stream else demo.ApartmentStream(80)
    )
    parts = make_parts(stream, arguments)
    field, frames = parts[0]
    rows = {}
    print("| off by | " + " | ".join(DECIMALS) + " | ms |\n" + "| --- " * (len(DECIMALS) + 2) + "|")
    for distance_m, angle_deg in (OCCLUDED_CASE,) if arguments.occluded else CASES:
        name = f"{100 * distance_m:g} cm, {angle_deg:g} degrees"
        rows[name], ms = measure_case(parts, distance_m, angle_deg, arguments.tries)
        cells = [f"{rows[name][figure]:.{digits}f}" for figure, digits in DECIMALS.items()]
        print(f"| {name} | " + " | ".join(cells) + f" | {ms:.1f} |", flush=True)
    rng = np.random.default_rng(1)
    foreign = [rng.uniform(-3, 3, (20_000, 3)).astype(np.float32), 0.6 * frames[0][0]]
    for cloud, name in zip(foreign, ("random points", "a view scaled by 0.6"), strict=True):
        found = hio.refine_pose(field, cloud, frames[0][1])
        print(f"{name}: converged {bool(found.converged)}, inliers {float(found.inliers):.2f}")
    if arguments.hypotheses:
        print_hypotheses(field, frames, arguments.hypotheses)
    name = arguments.stream.stem if arguments.stream else "demo"
    name += ", occluded" * arguments.occluded + f", {arguments.config}"
    name += ", all frames" * arguments.all
    name += f", {arguments.between} poses" * bool(arguments.between)
    name += f", {arguments.tries} tries" * (arguments.tries != (1 if arguments.between else 10))
    name += f", baked at {arguments.bake} m" if arguments.bake else ""
    return 1 if pose_record.finish(arguments, "refining", name, rows) else 0


if __name__ == "__main__":
    sys.exit(main())
