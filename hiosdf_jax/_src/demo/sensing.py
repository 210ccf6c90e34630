"""What the exploring robot senses with: its camera, where that is mounted, and its map."""

from __future__ import annotations

from typing import Any

import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.demo.apartment import BOUNDS_WORLD
from hiosdf_jax._src.demo.camera import DepthCamera
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.state.pytrees import MapState

# The camera looks over the floor ahead, in portrait format.
CAMERA_HEIGHT = 1.1  # m
_CAMERA_AHEAD = 0.2  # m, from the robot's axis
_WIDTH, _HEIGHT, _MAX_RANGE = 108, 144, 5.0
_MAP_TOP = 2.0  # m; nothing higher matters to the robot


def robot_camera(model: Any) -> DepthCamera:
    """Returns the robot's camera, a noisy one.

    Args:
        model: The apartment.

    Returns:
        The camera.
    """
    return DepthCamera(model, _WIDTH, _HEIGHT, _MAX_RANGE, noise=True)


def camera_pose(state: np.ndarray, pitch: float) -> np.ndarray:
    """Computes the camera's pose on the robot.

    Args:
        state: (5,), or its first three components: x, y (m), yaw (rad).
        pitch: Angle of the gaze below the horizon, rad.

    Returns:
        (4, 4) T_world_sensor, m; optical frame (x right, y down, z forward).
    """
    x, y, yaw = np.asarray(state[:3], float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward = np.array([cos, sin, -np.tan(pitch)]) * np.cos(pitch)
    right = np.array([sin, -cos, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = x + _CAMERA_AHEAD * cos, y + _CAMERA_AHEAD * sin, CAMERA_HEIGHT
    return pose


def map_config() -> Config:
    """Returns the configuration of the robot's map, smaller than `Config.light`."""
    low, (x, y, _) = BOUNDS_WORLD
    return Config.light(
        (low, (x, y, _MAP_TOP)),
        max_range=_MAX_RANGE,
        max_points=_WIDTH * _HEIGHT,
        near_samples=3000,
        far_samples=6000,
        local_points=50,
        hidden_width=64,
        hidden_layers=1,
        distance_horizon=1.5,
        frontier_horizon=0.6,
    )


def scan_from_above(state: MapState, xy: np.ndarray) -> MapState:
    """Adds a scan of the free floor around the robot, seen from above.

    The camera cannot see beneath itself, and unseen space is solid: without this scan the robot
    would start in collision.

    Args:
        state: The map.
        xy: (2,) m, where the robot stands.

    Returns:
        The new map.
    """
    radius, height = 0.45, 4.5
    spots = np.linspace(-radius, radius, 31)
    x, y = (axis.ravel() for axis in np.meshgrid(spots, spots))
    disk = np.hypot(x, y) <= radius
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # looks down
    pose[:3, 3] = *xy, height
    cloud = np.column_stack([x[disk], y[disk], np.full(disk.sum(), height)])
    return pipeline.update(state, cloud.astype(np.float32), pose)
