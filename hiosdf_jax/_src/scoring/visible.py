"""Points of the free space that a stream observes, with the exact distances there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.stream import BadFrameError, Stream, read_frame
from hiosdf_jax._src.datasets.truth import GroundTruth, choose_thin
from hiosdf_jax._src.scoring.scene import Scene

_RAYS_PER_FRAME = 10_000
_TOLERANCE = 0.2  # m, between a return and the scene's surface
_LEAST_AGREEMENT = 0.5  # share of the returns that have to be within it


class StreamRays(NamedTuple):
    """Returns of a stream, as rays.

    Attributes:
        frame: (R,) int32, ascending.
        origin_world: (R, 3) float64 m, the sensor's position.
        direction_world: (R, 3) float64, unit vectors.
        range: (R,) float64 m, as measured.
    """

    frame: np.ndarray
    origin_world: np.ndarray
    direction_world: np.ndarray
    range: np.ndarray


def read_rays(stream: Stream, max_range: float = np.inf) -> StreamRays:
    """Draws returns from each frame of a stream, in one reading with a progress bar.

    Args:
        stream: The frames; bad ones are skipped.
        max_range: m; farther returns are left out.

    Returns:
        Up to 10,000 returns per frame.

    Raises:
        ValueError: No frame has a return in range.

    Example:
        rays = scoring.read_rays(stream, max_range=6.0)
        path_world = scoring.sensor_path(rays)
    """
    from tqdm import tqdm

    rng = np.random.default_rng(0)
    frames, origins, directions, ranges = [], [], [], []
    for i in tqdm(range(len(stream)), desc="reading rays", unit="frame"):
        try:
            cloud, pose = read_frame(stream, i)
        except BadFrameError:
            continue
        lengths = np.linalg.norm(cloud.astype(float), axis=-1)  # NaN for no return
        usable = np.flatnonzero((lengths > 0) & (lengths <= max_range))
        drawn = np.sort(rng.choice(usable, min(_RAYS_PER_FRAME, len(usable)), replace=False))
        arrows = cloud[drawn].astype(float) @ pose[:3, :3].T.astype(float)
        length = np.linalg.norm(arrows, axis=-1)
        frames.append(np.full(len(drawn), i, np.int32))
        origins.append(np.broadcast_to(pose[:3, 3].astype(float), arrows.shape))
        directions.append(arrows / length[:, None])
        ranges.append(length)
    if not sum(map(len, frames)):
        raise ValueError(
            f"none of the {len(stream)} frames has a return within {max_range} m, expected some"
        )
    return StreamRays(*(np.concatenate(parts) for parts in (frames, origins, directions, ranges)))


def sensor_path(rays: StreamRays) -> np.ndarray:
    """Lists the positions of the sensor.

    Args:
        rays: From `read_rays`.

    Returns:
        (F, 3) float64 m, world frame, one position per frame that has rays.

    Example:
        path_world = scoring.sensor_path(scoring.read_rays(stream))
    """
    return rays.origin_world[np.unique(rays.frame, return_index=True)[1]]


def sample_visible(
    scene: Scene, rays: StreamRays, count: int = 25_000, seed: int = 1
) -> GroundTruth:
    """Draws points of the free space that a stream observes, with the exact distances there.

    For each point it draws a frame uniformly, then one of its rays, then a position on the ray
    between the sensor and the surface. The surface is where the ray meets the mesh or, for a scene
    that cannot cast rays, where it returned. Rays that return more than 0.2 m from the scene's
    surface are left out: they met something that the scene does not contain.

    Example:
        rays = read_rays(stream, max_range=6.0)
        scene = read_scene("house.ply", sensor_path(rays))
        truth = sample_visible(scene, rays)

    Args:
        scene: The exact distances.
        rays: The rays of the stream.
        count: Number of points in free space, and number of points on surfaces. The result has
            somewhat fewer where frames have no rays or the scene has gaps.
        seed: Seed of the draws.

    Returns:
        The exact distances. Thin parts that fewer than 10 of the rays met are left out.

    Raises:
        ValueError: Fewer than half of the returns lie near the scene's surface, so it is in another
            frame or unit.
    """
    rng = np.random.default_rng(seed)
    lengths, met, thin_part = _surface_along(scene, rays)
    if met.mean() < _LEAST_AGREEMENT:
        raise ValueError(
            f"only {met.mean():.0%} of the stream's returns lie within {_TOLERANCE} m of the "
            f"scene's surface, expected {_LEAST_AGREEMENT:.0%}: is the scene in meters, and in the "
            "stream's world frame?"
        )
    frames = np.unique(rays.frame[met])
    quotas = rng.multinomial(count, np.full(len(frames), 1 / len(frames)), size=2).T
    free, surface = [], []
    for frame, (free_quota, surface_quota) in zip(frames, quotas, strict=True):
        usable = np.flatnonzero(met & (rays.frame == frame))
        free.append(rng.choice(usable, free_quota))
        surface.append(rng.choice(usable, surface_quota))
    free, surface = np.concatenate(free), np.concatenate(surface)

    def at(rows: np.ndarray, shares: np.ndarray | float = 1.0) -> np.ndarray:
        steps = (shares * lengths[rows])[:, None] * rays.direction_world[rows]
        # Rounded before the distance is computed, which is then exact at the points returned.
        return (rays.origin_world[rows] + steps).astype(np.float32)

    points = at(free, rng.uniform(size=len(free)))
    sdf, grad = scene.sdf_and_grad(points)
    if scene.cast is not None:
        # The line from the sensor is free, whatever sign the scene gives where it cannot decide.
        grad, sdf = np.where(sdf[:, None] < 0, -grad, grad), np.abs(sdf)
    known = np.isfinite(sdf) & np.isfinite(grad).all(axis=-1)
    surface_points = at(surface)
    if scene.cast is None:
        surface_points = _project(scene, surface_points)
    return GroundTruth(
        points_world=points[known],
        sdf=sdf[known].astype(np.float32),
        grad=grad[known].astype(np.float32),
        frame=rays.frame[free[known]],
        surface_points_world=surface_points,
        thin_points_world=at(choose_thin(np.where(met, thin_part, -1), rng)),
    )


def _surface_along(scene: Scene, rays: StreamRays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finds the scene's surface along each ray.

    Returns:
        lengths: (R,) m, from the sensor to the surface.
        met: (R,) bool, the ray returned from that surface.
        thin_part: (R,) int, number of the thin part that the ray meets; -1 for other surfaces.
    """
    if scene.cast is not None:
        lengths, thin_part = scene.cast(rays.origin_world, rays.direction_world)
        return lengths, np.abs(lengths - rays.range) <= _TOLERANCE, thin_part
    returns_world = rays.origin_world + rays.range[:, None] * rays.direction_world
    met = np.abs(scene.sdf_and_grad(returns_world)[0]) <= _TOLERANCE  # False for NaN
    return rays.range, met, np.full(len(rays.range), -1)


def _project(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Moves points to the surface, by one step against the gradient; without those it cannot."""
    offset, normal = scene.sdf_and_grad(points)
    moved = (points - offset[:, None] * normal).astype(np.float32)
    return moved[np.isfinite(moved).all(axis=-1)]
