"""Refines perturbed poses of frames that a map was not given, and prints the errors that remain.

    python -m benchmarks.registration
    python -m benchmarks.registration --stream ../shared/data/house_depth.npz --tries 10
    python -m benchmarks.registration --between 200 --tries 1

Without `--stream` the frames are those of the demo's camera. `--between` takes this many poses on
its path instead, almost all between the frames of the map. `--map` takes a saved map, made of all
frames but the held-out ones, instead of making it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax import datasets, demo
from hiosdf_jax._src.scoring.held_out import held_out_frames

CASES = ((0.0, 0.0), (0.05, 3.0), (0.15, 6.0))  # m, degrees


def perturb(pose, rng, way_m, angle_deg):
    """Moves a pose by a given way and angle, in random directions."""
    way, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    result = np.array(pose, float)
    turn = Rotation.from_rotvec(np.radians(angle_deg) * axis).as_matrix()
    result[:3, :3] = turn @ result[:3, :3]
    result[:3, 3] += way_m * way
    return result.astype(np.float32)


def error(pose, exact):
    """The motion from the exact pose, (6,) m and rad."""
    pose, exact = np.asarray(pose, float), np.asarray(exact, float)
    turn = Rotation.from_matrix(pose[:3, :3] @ exact[:3, :3].T).as_rotvec()
    return np.concatenate([pose[:3, 3] - exact[:3, 3], turn])


def make_map(stream, held_out):
    """Maps all frames but some, with `Config.light`."""
    if isinstance(stream, demo.ApartmentStream):
        bounds, max_range = demo.BOUNDS_WORLD, stream.max_range
    else:
        bounds, max_range = datasets.find_bounds(stream)
    state = hio.init(hio.Config.light(bounds, max_range=max_range), jax.random.key(0))
    for i in range(len(stream)):
        if i not in held_out:
            state = hio.update(state, *stream[i])
    return state


def print_case(field, frames, way_m, angle_deg, tries):
    """Refines perturbed poses of all frames and prints a row of the table."""
    rng = np.random.default_rng(0)
    errors, squares, seconds, converged = [], [], [], []
    for cloud, pose in frames:
        for _ in range(tries if way_m else 1):
            start = perturb(pose, rng, way_m, angle_deg)
            begin = time.perf_counter()
            found = jax.block_until_ready(hio.refine_pose(field, cloud, start))
            seconds.append(time.perf_counter() - begin)
            away = error(found.pose, pose)
            errors.append([100 * np.linalg.norm(away[:3]), np.degrees(np.linalg.norm(away[3:]))])
            squares.append(away @ np.linalg.solve(np.asarray(found.covariance, float), away))
            converged.append(bool(found.converged))
    way, angle = np.transpose(errors)
    print(
        f"| {100 * way_m:g} cm, {angle_deg:g} deg | {len(way)} | {np.median(way):.2f} | "
        f"{np.percentile(way, 95):.2f} | {way.max():.2f} | {np.median(angle):.3f} | "
        f"{np.percentile(angle, 95):.3f} | {np.mean(squares):.1f} | {np.mean(converged):.2f} | "
        f"{1e3 * np.median(seconds[1:]):.0f} |",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description="Refines perturbed poses.")
    parser.add_argument("--stream", type=Path, help="a recording; the demo's camera by default")
    parser.add_argument("--map", type=Path, help="a saved map without the held-out frames")
    parser.add_argument("--tries", type=int, default=10, help="perturbations per frame")
    parser.add_argument("--between", type=int, default=0, help="poses between the demo's frames")
    arguments = parser.parse_args()
    if arguments.between and arguments.stream:
        parser.error("--between is for the demo, without --stream")
    stream = demo.ApartmentStream(80)
    if arguments.stream:
        stream = datasets.open_stream(arguments.stream)
    held_out = held_out_frames(len(stream))
    state = hio.load(arguments.map) if arguments.map else make_map(stream, held_out)
    field = hio.snapshot(state)
    frames = [stream[i] for i in held_out]
    if arguments.between:
        dense = demo.ApartmentStream(arguments.between)
        frames = [dense[i] for i in range(len(dense))]
    print("| off by | poses | median, cm | 95 %, cm | most, cm | median, deg | 95 %, deg |", end="")
    print(" normalized square, 6 expected | converged | ms |")
    print("| --- " * 10 + "|")
    for way_m, angle_deg in CASES:
        print_case(field, frames, way_m, angle_deg, arguments.tries)
    rng = np.random.default_rng(1)
    foreign = [rng.uniform(-3, 3, (20_000, 3)).astype(np.float32), 0.6 * frames[0][0]]
    for cloud, name in zip(foreign, ("random points", "a view scaled by 0.6"), strict=True):
        found = hio.refine_pose(field, cloud, frames[0][1])
        print(f"{name}: converged {bool(found.converged)}, inliers {float(found.inliers):.2f}")


if __name__ == "__main__":
    main()
