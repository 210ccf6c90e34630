"""A depth camera in a static MuJoCo model."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_MIN_RANGE = 0.3  # m, below which a depth camera is blind
_DROP_OUT = 0.005  # fraction of pixels that drop out at random
_FLYING = 0.15  # fraction of pixels at a depth edge that mix foreground and background
_EDGE = 0.1  # depth step to a neighbor that makes an edge, relative to the nearer depth

# mj_multiRay of MuJoCo 3 misses some surfaces that mj_ray finds.
_ONE_BY_ONE = int(mujoco.__version__.split(".")[0]) < 4


class DepthCamera:
    """A pinhole camera, horizontal field of view 90 degrees; x right, y down, z forward."""

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, max_range: float, noise: bool
    ) -> None:
        """Prepares the camera.

        Args:
            model: The scene, in the model's initial configuration.
            width: Pixels per row.
            height: Pixels per column.
            max_range: Largest range of a return, m. The least is 0.3 m.
            noise: Whether depths have a Kinect's noise, some pixels drop out, and some fly between
                foreground and background at depth edges.

        Raises:
            ValueError: `width` or `height` < 1, or `max_range` <= 0.3.
        """
        if width < 1 or height < 1:
            raise ValueError(f"width, height = {width}, {height}, expected >= 1")
        if not max_range > _MIN_RANGE:
            raise ValueError(f"max_range = {max_range}, expected > {_MIN_RANGE}")
        self.height, self.width = height, width
        self.max_range, self.noise = max_range, noise
        self._model, self._data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        # The ray through the center of every pixel, with a depth (z) of 1.
        focal = width / 2  # pixels: half the width spans 45 degrees
        u = (np.arange(width) + 0.5 - width / 2) / focal
        v = (np.arange(height) + 0.5 - height / 2) / focal
        x, y = np.meshgrid(u, v)
        self._rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        self._lengths = np.linalg.norm(self._rays, axis=1)

    def cloud(self, pose: np.ndarray, seed: Any) -> np.ndarray:
        """Takes an image.

        Args:
            pose: (4, 4) T_world_sensor, m.
            seed: Seed of the noise, for `numpy.random.default_rng`.

        Returns:
            (height * width, 3) float32, m, sensor frame, row-major; a row of NaN is not a return.
        """
        depth = self.exact_depth(pose)
        if self.noise:
            depth = _add_noise(depth.reshape(self.height, self.width), seed).ravel()
        depth = np.where(self._in_range(depth), depth, np.nan)
        return (depth[:, None] * self._rays).astype(np.float32)

    def exact_depth(self, pose: np.ndarray) -> np.ndarray:
        """Casts the rays, without noise and without limits of range.

        Args:
            pose: (4, 4) T_world_sensor, m.

        Returns:
            (height * width,) float64, depth along the optical axis, m; negative where a ray hits
            nothing, which cannot happen in a closed model.
        """
        return self._cast(pose)[0]

    def exact_surface(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Finds the surface points within the camera's limits of range.

        Args:
            pose: (4, 4) T_world_sensor, m.

        Returns:
            points_world: (n, 3) float64, m; n <= height * width.
            geom: (n,) int32, index of the geom that each point is on.
        """
        depth, geom = self._cast(pose)
        seen = self._in_range(depth)
        points_world = depth[seen, None] * self._rays[seen] @ pose[:3, :3].T + pose[:3, 3]
        return points_world, geom[seen]

    def _cast(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depths (height * width,) m, and the geoms that the rays hit."""
        directions = (self._rays / self._lengths[:, None]) @ pose[:3, :3].T
        ranges, geoms = cast_rays(self._model, self._data, pose[:3, 3], directions)
        return ranges / self._lengths, geoms

    def _in_range(self, depth: np.ndarray) -> np.ndarray:
        ranges = depth * self._lengths
        return (ranges >= _MIN_RANGE) & (ranges <= self.max_range)


def cast_rays(
    model: mujoco.MjModel, data: mujoco.MjData, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Casts rays from a point against all geoms of a model.

    Args:
        model: The model.
        data: Its state after `mujoco.mj_forward`.
        origin: (3,) m, world frame.
        directions: (N, 3) unit vectors, world frame.

    Returns:
        Ranges (N,) m, and the geoms that the rays hit, (N,) int32; -1 and -1 where there is none.
    """
    count = len(directions)
    ranges, geoms = np.empty(count), np.empty(count, np.int32)
    if _ONE_BY_ONE:
        for k, direction in enumerate(directions):
            ranges[k] = mujoco.mj_ray(model, data, origin, direction, None, 1, -1, geoms[k : k + 1])
        return ranges, geoms
    mujoco.mj_multiRay(
        m=model,
        d=data,
        pnt=np.asarray(origin, np.float64),
        vec=np.ascontiguousarray(directions, np.float64).ravel(),
        geomgroup=None,  # every group
        flg_static=True,  # static geoms included
        bodyexclude=-1,
        geomid=geoms,
        dist=ranges,
        normal=None,
        nray=count,
        cutoff=mujoco.mjMAXVAL,
    )
    return ranges, geoms


def _add_noise(depth: np.ndarray, seed: Any) -> np.ndarray:
    """Adds a structured-light camera's noise to exact depths (H, W), m; NaN is a dropped pixel.

    The noise is that of the Kinect (Nguyen, Izadi, Lovell: Modeling Kinect Sensor Noise for
    Improved 3D Reconstruction and Tracking, 3DIMPVT 2012).
    """
    rng = np.random.default_rng(seed)
    height, width = depth.shape
    # A flying pixel averages over an edge: its depth is between its own and a neighbor's.
    down, right = rng.integers(-1, 2, size=(2, height, width))
    row, column = np.indices(depth.shape)
    neighbor = depth[np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)]
    at_edge = np.abs(neighbor - depth) > _EDGE * np.minimum(depth, neighbor)
    flies = at_edge & (rng.uniform(size=depth.shape) < _FLYING)
    mixed = depth + rng.uniform(size=depth.shape) * (neighbor - depth)
    depth = np.where(flies, mixed, depth)

    depth = depth + (0.0012 + 0.0019 * (depth - 0.4) ** 2) * rng.normal(size=depth.shape)
    return np.where(rng.uniform(size=depth.shape) < _DROP_OUT, np.nan, depth)
