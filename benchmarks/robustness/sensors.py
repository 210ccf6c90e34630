"""A depth camera and a LiDAR that scan a world."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.robustness.worlds import World


class Sensor(NamedTuple):
    """A sensor's rays and errors.

    Attributes:
        name: "camera" or "lidar".
        directions: (n, 3) unit vectors, sensor frame.
        forward: (n,) cosine between a ray and the axis along which the error is defined.
        sigma: Standard deviation in m of a depth along that axis.
        drop_out: Share of the rays without a return.
        min_range: m, nothing nearer returns.
    """

    name: str
    directions: np.ndarray
    forward: np.ndarray
    sigma: Callable[[np.ndarray], np.ndarray]
    drop_out: float
    min_range: float


class Scan(NamedTuple):
    """One scan, and what it truly saw.

    Attributes:
        cloud: (n, 3) float32 m, sensor frame; NaN for no return.
        pose: (4, 4) T_world_sensor.
        exact_world: (n, 3) m, world, the points that the rays hit without any error.
        hit: (n,) which thing of the world each ray hit, or `worlds.BACKGROUND`.
    """

    cloud: np.ndarray
    pose: np.ndarray
    exact_world: np.ndarray
    hit: np.ndarray


def depth_camera(width: int = 160, height: int = 120) -> Sensor:
    """A Kinect-like camera, 90 degrees wide; x right, y down, z forward."""
    u = (np.arange(width) + 0.5 - width / 2) / (width / 2)
    v = (np.arange(height) + 0.5 - height / 2) / (width / 2)
    x, y = np.meshgrid(u, v)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return Sensor(
        name="camera",
        directions=directions,
        forward=directions[:, 2],
        sigma=lambda depth: 0.0012 + 0.0019 * (depth - 0.4) ** 2,
        drop_out=0.005,
        min_range=0.1,
    )


def lidar(rings: int = 16, columns: int = 1024) -> Sensor:
    """A spinning LiDAR with rings from -15 to 15 degrees; x forward, z up."""
    elevation = np.radians(np.linspace(-15, 15, rings))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None]
    directions = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        axis=-1,
    ).reshape(-1, 3)
    return Sensor(
        name="lidar",
        directions=directions,
        forward=np.ones(len(directions)),
        sigma=lambda depth: np.full_like(depth, 0.01),
        drop_out=0.005,
        min_range=0.1,
    )


SENSORS = {"camera": depth_camera, "lidar": lidar}


def scan(sensor: Sensor, world: World, pose: np.ndarray, rng: np.random.Generator) -> Scan:
    """Scans a world.

    Args:
        sensor: The sensor.
        world: The world at that moment.
        pose: (4, 4) T_world_sensor, in free space.
        rng: Source of the noise.

    Returns:
        The scan.
    """
    rays_world = sensor.directions @ pose[:3, :3].T
    exact, hit = world.cast(pose[:3, 3], rays_world)
    depth = exact * sensor.forward
    noisy = depth + sensor.sigma(depth) * rng.normal(size=len(depth))
    ranges = noisy / sensor.forward
    lost = rng.uniform(size=len(ranges)) < sensor.drop_out
    returns = np.isfinite(ranges) & (ranges >= sensor.min_range) & ~lost
    cloud = np.where(returns[:, None], ranges[:, None] * sensor.directions, np.nan)
    return Scan(
        cloud=cloud.astype(np.float32),
        pose=pose,
        exact_world=pose[:3, 3] + exact[:, None] * rays_world,
        hit=hit,
    )


def look_at(position: np.ndarray, target: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The pose of a sensor that faces a target.

    Args:
        position: (3,) m, world.
        target: (3,) m, world; not straight above or below.
        sensor: A LiDAR stays level and turns its x axis there; a camera turns its z axis there.

    Returns:
        (4, 4) T_world_sensor.
    """
    forward = np.subtract(target, position)
    if sensor.name == "lidar":
        forward = forward * [1, 1, 0]
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    columns = (forward, -right, -down) if sensor.name == "lidar" else (right, down, forward)
    pose = np.eye(4)
    pose[:3, :3] = np.stack(columns, axis=1)
    pose[:3, 3] = position
    return pose
