"""A fast robot and an obstacle behind a corner, under both policies for unseen space.

    python -m benchmarks.blind_corner --seeds 100 --output blind_corner.json

The goal is around the corner of a corridor. A box stands where it cannot be seen from the start.
The robot scans, maps and drives by MPPI, once with unseen space as an obstacle and once with the
network's prediction there. Collisions are with the exact boxes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hiosdf_jax as hio
from benchmarks import records
from hiosdf_jax._src.demo.driver import Driver, head, make_driver, make_task
from hiosdf_jax._src.demo.geodesic import lay_floor
from hiosdf_jax._src.demo.robot import Robot, motion

HEIGHT = 0.6  # m, of the corridor
SENSOR_HEIGHT = 0.3  # m, also of the robot's center
BOUNDS = ((-0.1, -0.1, -0.1), (4.9, 5.5, 0.7))
ROBOT = Robot(
    heights=(SENSOR_HEIGHT,), max_speed=2.0, max_acceleration=2.0, max_turn_rate=2.0, step=0.1
)
SENSE_EVERY = 10  # control steps
TIME_LIMIT = 40.0  # s
REACHED = 0.25  # m
MAX_RANGE = 5.0  # m
NOISE = 0.01  # m, standard deviation of a range


@dataclasses.dataclass(frozen=True)
class Scene:
    """Solid boxes (B, 2, 3) m as (low, high) corners; start and goal, (2,) m."""

    boxes: np.ndarray
    start: np.ndarray
    goal: np.ndarray


def draw_scene(seed: int) -> Scene:
    """Draws a corridor along x that turns left, with a box close behind the inner corner."""
    rng = np.random.default_rng(seed)
    width = rng.uniform(1.3, 1.7)
    corner = rng.uniform(2.6, 3.0)  # x of the inner corner; its y is the width
    end = rng.uniform(4.6, 5.2)  # y of the far end
    far, high = corner + width, HEIGHT
    gap = 0.7  # m between box and wall, for a robot of 0.4 m
    size = rng.uniform([0.3, 0.2], [width - gap, 0.5])
    offset = rng.uniform(0.0, 0.5)
    y = width + offset
    # Most boxes stand at the inner wall, where they cannot be seen, some at the outer one.
    x = corner if rng.uniform() < 0.8 else far - size[0]
    thick = 0.2
    solid = [
        ((-thick, -thick, -thick), (far + thick, end + thick, 0)),
        ((-thick, -thick, high), (far + thick, end + thick, high + thick)),
        ((-thick, -thick, 0), (0, width, high)),
        ((-thick, -thick, 0), (far + thick, 0, high)),
        ((far, -thick, 0), (far + thick, end + thick, high)),
        ((-thick, width, 0), (corner, end + thick, high)),
        ((corner, end, 0), (far, end + thick, high)),
        ((x, y, 0), (x + size[0], y + size[1], high)),
    ]
    start = np.array([rng.uniform(0.4, 0.8), rng.uniform(0.5, width - 0.5)])
    goal = np.array([rng.uniform(corner + 0.5, far - 0.5), end - 0.6])
    return Scene(np.array(solid, float), start, goal)


def exact_sdf(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Computes the distance (N,) m of points (N, 3) m to boxes; inside of a box it is <= 0."""
    center, half = boxes.mean(axis=1), (boxes[:, 1] - boxes[:, 0]) / 2
    beyond = np.abs(points[:, None] - center) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
    return (outside + np.minimum(beyond.max(axis=-1), 0)).min(axis=1)


def cast(boxes: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Casts rays along unit directions (N, 3); returns ranges (N,) m, inf without a hit."""
    with np.errstate(divide="ignore"):
        inverse = 1 / directions[:, None]
    to_faces = (boxes.transpose(1, 0, 2)[:, None] - origin) * inverse  # (2, N, B, 3)
    enter = to_faces.min(axis=0).max(axis=-1)
    leave = to_faces.max(axis=0).min(axis=-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf).min(axis=1)


def lidar_directions(columns: int = 180, rows: int = 25) -> np.ndarray:
    """Returns unit vectors (N, 3), up to 85 degrees off the horizon and densest at it."""
    slope = np.linspace(-1, 1, rows)
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, columns, endpoint=False) + 1e-3,
        np.radians(85) * slope * np.abs(slope) + 1e-3,
    )
    level = np.cos(elevation)
    unit = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return np.stack(unit, axis=-1).reshape(-1, 3)


def map_config() -> hio.Config:
    """Returns the configuration of a small map, about 20,000 voxels."""
    return hio.Config.light(
        BOUNDS,
        max_range=MAX_RANGE,
        max_points=len(lidar_directions()),
        near_samples=1000,
        far_samples=2000,
        local_points=50,
        hidden_width=32,
        hidden_layers=1,
        distance_horizon=1.0,
        frontier_horizon=1.0,
    )


def run(scene: Scene, seed: int, unknown: str, driver: Driver) -> dict[str, object]:
    """Drives to the goal once."""
    rng = np.random.default_rng((seed, 1))
    directions = lidar_directions()
    floor = lay_floor(BOUNDS, 0.1)
    map_state = hio.init(map_config(), jax.random.key(seed))
    state = jnp.array([*scene.start, 0.0, 0.0, 0.0])
    plan, states = driver.plan, [np.asarray(state)[None]]
    steps = int(TIME_LIMIT / ROBOT.step)
    for k in range(steps):
        x, y, yaw = np.asarray(state[:3], float)
        if k % SENSE_EVERY == 0:
            pose = np.array(
                [
                    [np.cos(yaw), -np.sin(yaw), 0, x],
                    [np.sin(yaw), np.cos(yaw), 0, y],
                    [0, 0, 1, SENSOR_HEIGHT],
                    [0, 0, 0, 1],
                ]
            )
            ranges = cast(scene.boxes, pose[:3, 3], directions @ pose[:3, :3].T)
            ranges += NOISE * rng.normal(size=len(ranges))
            cloud = np.where(ranges < MAX_RANGE, ranges, np.nan)[:, None] * directions
            map_state = hio.update(map_state, cloud, pose)
            task, path_from, _ = make_task(ROBOT, hio.snapshot(map_state), floor, scene.goal)
        task = head(task, path_from, np.array([x, y]))
        control, plan, _ = driver.step(plan, state, task)
        passed = motion(ROBOT, state, control)
        states.append(np.asarray(passed))
        state = passed[-1]
        if np.hypot(*(np.asarray(state[:2]) - scene.goal)) < REACHED:
            break
    path = np.concatenate(states)
    centers = np.column_stack([path[:, :2], np.full(len(path), SENSOR_HEIGHT)])
    least = float(exact_sdf(scene.boxes, centers).min() - ROBOT.radius)
    return {
        "seed": seed,
        "unknown": unknown,
        "reached": bool(np.hypot(*(path[-1, :2] - scene.goal)) < REACHED),
        "collided": least < 0,
        "least_clearance_m": least,
        "seconds": (k + 1) * ROBOT.step,
    }


def summarize(runs: list[dict]) -> dict[str, object]:
    """Counts outcomes over the runs of one policy."""
    return {
        "runs": len(runs),
        "collided": sum(r["collided"] for r in runs),
        "reached_without_collision": sum(r["reached"] and not r["collided"] for r in runs),
        "least_clearance_m": min(r["least_clearance_m"] for r in runs),
        "median_seconds": float(np.median([r["seconds"] for r in runs])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="A blind corner under both policies.")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = dict(records.provenance())
    for unknown in ("obstacle", "network"):
        driver = make_driver(ROBOT, unknown, jax.random.key(0), horizon=20)
        begin = time.perf_counter()
        runs = [run(draw_scene(s), s, unknown, driver) for s in range(options.seeds)]
        result[unknown] = summarize(runs) | {
            "wall_s": time.perf_counter() - begin,
            "collided_seeds": [r["seed"] for r in runs if r["collided"]],
            "not_reached_seeds": [r["seed"] for r in runs if not r["reached"]],
        }
        print(unknown, json.dumps(result[unknown]))
    if options.output:
        records.write(options.output, result)


if __name__ == "__main__":
    main()
