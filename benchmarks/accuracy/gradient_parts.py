"""What the error of the gradient near surfaces is made of.

    python -m benchmarks.accuracy.gradient_parts

The error is 1 - cos of the angle between the map's gradient and the exact one, within 5 cm of the
true surface. Each point counts for the first reason that holds there.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import trange

import hiosdf_jax as hio
from benchmarks import records
from benchmarks.accuracy.sources import open_source
from hiosdf_jax._src.grid.patches import EXTENT_DEVIATIONS

_NEAR_M = 0.05
_FEW_HITS = 5
_BESIDE_VOXELS = 0.02  # off the rectangle of a patch

# The truth turns if its gradient 1.5 cm away has a smaller cosine than this.
_MOVED_M, _STEP_M = 0.015, 1e-3
_LEAST_COSINE = 0.9

Distance = Callable[[np.ndarray], np.ndarray]


class Part(NamedTuple):
    """Points whose gradient is wrong for the same reason.

    Attributes:
        share: Of all points.
        mean: Mean of 1 - cos at them.
    """

    share: float
    mean: float

    @property
    def error(self) -> float:
        """The part of the mean error of all points."""
        return self.share * self.mean


def split_error(
    state: hio.MapState, points_world: np.ndarray, exact: np.ndarray, distance: Distance
) -> dict[str, Part]:
    """Splits the mean error of the gradient by its reasons.

    Args:
        state: A map.
        points_world: Points near true surfaces, (n, 3) m.
        exact: Exact gradients there, (n, 3).
        distance: Maps points (n, 3) m to exact distances, (n,) m.

    Returns:
        {reason: its points}. The mean error is the sum of their `error`.
    """
    given = np.asarray(hio.sdf_and_grad(state, points_world.astype(np.float32))[1], float)
    lengths = np.linalg.norm(given, axis=1) * np.linalg.norm(exact, axis=1)
    cosine = np.sum(given * exact, axis=1) / np.maximum(lengths, 1e-9)
    hits, off = _nearest_patches(state, points_world)
    reasons = {
        "it points the other way: cos < 0": cosine < 0,
        "the true gradient turns within 1.5 cm": _turns(points_world, exact, distance),
        "the nearest patch has fewer than 5 hits": hits < _FEW_HITS,
        "the nearest patch ends before the point": off > _BESIDE_VOXELS,
        "the normal of the patch": np.ones(len(cosine), bool),
    }
    parts, left = {}, np.ones(len(cosine), bool)
    for reason, holds in reasons.items():
        chosen, left = left & holds, left & ~holds
        error = 1 - cosine[chosen]
        parts[reason] = Part(float(chosen.mean()), float(error.mean()) if len(error) else 0.0)
    return parts


def _turns(points_world: np.ndarray, exact: np.ndarray, distance: Distance) -> np.ndarray:
    """Returns a mask of the points around which the exact gradient is not constant."""
    turns = np.zeros(len(points_world), bool)
    for sign, axis in itertools.product((-1, 1), np.eye(3)):
        moved, steps = points_world + sign * _MOVED_M * axis, _STEP_M * np.eye(3)
        change = [distance(moved + step) - distance(moved - step) for step in steps]
        gradient = np.stack(change, axis=-1) / (2 * _STEP_M)
        # An unsigned distance has no gradient on the surface.
        smooth = np.linalg.norm(gradient, axis=1) > _LEAST_COSINE
        turns |= smooth & (np.abs(np.sum(gradient * exact, axis=1)) < _LEAST_COSINE)
    return turns


def _nearest_patches(
    state: hio.MapState, points_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest patch to each point, in the 27 voxels around it.

    Returns:
        Its hits, and how far off its rectangle the point lies along it, voxels, (n,) each.
    """
    config, evidence = state.config, state.grid.evidence
    mean, axes, counts = (
        np.asarray(each, float) for each in (evidence.mean, evidence.axes, evidence.hits)
    )
    place = points_world / config.voxel_size - np.asarray(config.corner_index)
    least, hits, off = np.full(len(place), np.inf), np.zeros(len(place)), np.zeros(len(place))
    for step in itertools.product((-1, 0, 1), repeat=3):
        voxel = np.floor(place).astype(int) + step
        inside = np.all((voxel >= 0) & (voxel < counts.shape), axis=1)
        row = tuple(np.clip(voxel, 0, np.subtract(counts.shape, 1)).T)
        half = EXTENT_DEVIATIONS * np.linalg.norm(axes[row], axis=-1)
        offset = place - (voxel + 0.5 + mean[row])
        along = np.einsum("nki,ni->nk", axes[row], offset)
        along *= EXTENT_DEVIATIONS / np.maximum(half, 1e-9)
        beside = np.linalg.norm(np.maximum(np.abs(along[:, :2]) - half[:, :2], 0), axis=1)
        reach = np.hypot(beside, along[:, 2])
        nearer = inside & (counts[row] >= config.min_hits) & (reach < least)
        for kept, new in ((least, reach), (hits, counts[row]), (off, beside)):
            kept[nearer] = new[nearer]
    return hits, off


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.gradient_parts")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write a record")
    options = parser.parse_args()
    source = open_source(options.data, "house_depth")
    if source.truth is None or source.distance is None:
        parser.error("needs house_depth.npz, its mesh, trimesh and libigl")
    config = hio.Config.light(source.extent.bounds, max_range=source.extent.max_range)
    state = hio.init(config, jax.random.key(0))
    for frame in trange(len(source.stream), desc="mapping", unit="frame"):
        state = hio.update(state, *source.stream[frame])
    near = np.abs(source.truth.sdf) < _NEAR_M
    points = source.truth.points_world[near].astype(float)
    parts = split_error(state, points, source.truth.grad[near], source.distance)
    for reason, part in parts.items():
        print(f"{reason:42}{part.share:8.1%} of the points, mean error {part.mean:.3f}, ", end="")
        print(f"together {part.error:.4f}")
    print(f"all {len(points):,} points: {sum(part.error for part in parts.values()):.4f}")
    if options.output:
        found: dict[str, Any] = {
            reason: {name: records.rounded(value, 4) for name, value in part._asdict().items()}
            for reason, part in parts.items()
        }
        record = records.read(options.output)
        records.write(options.output, record | {"now": records.provenance() | {"parts": found}})


if __name__ == "__main__":
    main()
