"""Maps a stream in parts, joins the parts, and prints the errors beside those of one pass.

    python -m benchmarks.merging ../shared/data/house_depth.npz

The parts are two halves, the same with the second half in a frame of its own, and eight submaps of
a trajectory that drifts by 20 cm and 2 degrees, of which the last poses close the loop. `--output`
writes a record of the errors, and `--gate` compares them with the committed one.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from benchmarks import pose_record
from hiosdf_jax import datasets, scoring

DRIFT_M, DRIFT_DEG = 0.20, 2.0
TURN_DEG = 37.0
SUBMAPS = 8
COLUMNS = ("visible_cm", "near_cm", "bias_cm", "recall", "fpr")


def rigid(angle_deg, shift):
    """A turn about z and a shift, (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    pose[:3, 3] = shift
    return pose


def drift_at(share, anchor_world):
    """The error of the trajectory after a share of it: a turn about its own place, and a shift."""
    motion = rigid(DRIFT_DEG * share, 0)
    shift = DRIFT_M * share * np.array([0.6, 0.8, 0])
    motion[:3, 3] = anchor_world - motion[:3, :3] @ anchor_world + shift
    return motion


def box_around(bounds, pose):
    """The box of the corners of a moved box."""
    corners = np.stack(np.meshgrid(*np.transpose(bounds)), axis=-1).reshape(-1, 3)
    corners = corners @ pose[:3, :3].T + pose[:3, 3]
    return corners.min(axis=0), corners.max(axis=0)


def map_frames(frames, bounds, max_range, motions):
    """Maps frames with `Config.light`, each moved by a motion of its own."""
    state = hio.init(hio.Config.light(bounds, max_range=max_range), jax.random.key(0))
    for (cloud, pose), motion in zip(frames, motions, strict=True):
        state = hio.update(state, cloud, (motion @ pose).astype(np.float32))
    return state


def score(name, state, truth, pose_map_world):
    """Scores a map, and prints a row of the table."""
    field = hio.snapshot(state)
    turn, shift = pose_map_world[:3, :3], pose_map_world[:3, 3]

    def answer(points_world):
        sdf, grad = hio.sdf_and_grad(field, (points_world @ turn.T + shift).astype(np.float32))
        return sdf, grad @ turn

    scores = scoring.evaluate(answer, truth)
    row = {column: float(scores[column]) for column in COLUMNS}
    print(f"| {name} | " + " | ".join(f"{value:.4g}" for value in row.values()) + " |", flush=True)
    return row


def main():
    parser = argparse.ArgumentParser(description="Joins maps of parts of a stream.")
    parser.add_argument("stream", type=Path, help="a recording with exact distances")
    pose_record.add_options(parser)
    options = parser.parse_args()
    stream = datasets.open_stream(options.stream)
    truth = datasets.read_truth(options.stream)
    bounds, max_range = datasets.find_bounds(stream)
    frames = [stream[i] for i in range(len(stream))]
    count, eye = len(frames), np.eye(4)
    rows = {}

    def add(name, state, pose_map_world=eye):
        rows[name] = score(name, state, truth, pose_map_world)

    print("| | " + " | ".join(COLUMNS) + " |\n" + "| --- " * (len(COLUMNS) + 1) + "|")
    one = map_frames(frames, bounds, max_range, [eye] * count)
    add("one pass", one)
    turn = rigid(TURN_DEG, (1.23, -0.57, 0.31))
    there = hio.transform(one, turn, box_around(bounds, turn))
    add("one pass, moved and moved back", hio.transform(there, np.linalg.inv(turn), bounds))

    half = count // 2
    first = map_frames(frames[:half], bounds, max_range, [eye] * half)
    second = map_frames(frames[half:], bounds, max_range, [eye] * (count - half))
    add("two halves, merged", hio.merge(first, second, eye))
    box = box_around(bounds, turn)
    second = map_frames(frames[half:], box, max_range, [turn] * (count - half))
    add("the same, one turned", hio.merge(first, second, np.linalg.inv(turn)))
    add("one pass in that frame", map_frames(frames, box, max_range, [turn] * count), turn)

    wide = np.add(bounds, [[-0.6] * 3, [0.6] * 3])
    submaps, drifts, motions = [], [], []
    for k, part in enumerate(np.array_split(np.arange(count), SUBMAPS)):
        drift = drift_at(k / (SUBMAPS - 1), frames[part[0]][1][:3, 3])
        own = [frames[i] for i in part]
        submaps.append(map_frames(own, wide, max_range, [drift] * len(part)))
        drifts.append(drift)
        motions += [drift] * len(part)
    add("a loop with drift", map_frames(frames, wide, max_range, motions))
    add("the same, corrected", hio.correct(submaps, np.linalg.inv(drifts), bounds))
    return 1 if pose_record.finish(options, "merging", options.stream.stem, rows) else 0


if __name__ == "__main__":
    sys.exit(main())
