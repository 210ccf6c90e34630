"""Converts depth and range images to point clouds (section III of the paper, "dense or sparse").

A cloud has one row per pixel or ray, in the order of the image, and NaN where there is no return.
Its shape depends on the sensor alone, so one compilation serves a stream.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from hiosdf_jax._src.numerics.intake import as_array


def depth_to_cloud(depth: ArrayLike, intrinsics: ArrayLike) -> Array:
    """Converts depth images of a pinhole camera to clouds.

    Args:
        depth: (..., H, W) m along the optical axis; 0, negative, NaN or inf is no return.
        intrinsics: (3, 3) pinhole matrix K in pixels, with pixel centers at integer coordinates.

    Returns:
        (..., H * W, 3) m, sensor frame (x right, y down, z forward), row by row of the image; NaN
        for no return.

    Raises:
        ValueError: Depth has fewer than two dimensions or intrinsics is not (3, 3).

    Example:
        depth = depth_mm / 1000.0  # (480, 640) m; 0 is not a return
        intrinsics = [[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]
        state = hio.update(state, datasets.depth_to_cloud(depth, intrinsics), pose)
    """
    depth = jnp.asarray(as_array("depth", depth))
    intrinsics = jnp.asarray(as_array("intrinsics", intrinsics))
    if depth.ndim < 2:
        raise ValueError(f"depth has shape {depth.shape}, expected (..., H, W)")
    if intrinsics.shape != (3, 3):
        raise ValueError(f"intrinsics has shape {intrinsics.shape}, expected (3, 3)")
    height, width = depth.shape[-2:]
    v = (jnp.arange(height) - intrinsics[1, 2])[:, None] / intrinsics[1, 1]
    # K[0, 1] is the skew, 0 for nearly all cameras but part of K.
    u = (jnp.arange(width) - intrinsics[0, 2] - intrinsics[0, 1] * v) / intrinsics[0, 0]
    directions = jnp.stack([u, jnp.broadcast_to(v, u.shape), jnp.ones_like(u)], axis=-1)
    flat = depth.reshape(*depth.shape[:-2], height * width)
    return _along(flat, directions.reshape(height * width, 3))


def ranges_to_cloud(ranges: ArrayLike, directions: ArrayLike) -> Array:
    """Converts one scan of a LiDAR to a cloud.

    Args:
        ranges: (...) m along each ray; 0, negative, NaN or inf is no return.
        directions: (..., 3) unit directions of the rays, sensor frame.

    Returns:
        (n, 3) m, sensor frame, for n rays; NaN for no return.

    Raises:
        ValueError: Directions is not (*ranges.shape, 3).

    Example:
        cloud = datasets.ranges_to_cloud(ranges, directions)  # (16, 1800) m, (16, 1800, 3)
        state = hio.update(state, cloud, pose)
    """
    ranges = jnp.asarray(as_array("ranges", ranges))
    directions = jnp.asarray(as_array("directions", directions))
    expected = (*ranges.shape, 3)
    if directions.shape != expected:
        raise ValueError(
            f"directions has shape {directions.shape}, expected {expected}, "
            f"one unit vector per range of {ranges.shape}"
        )
    return _along(ranges.reshape(-1), directions.reshape(-1, 3))


def _along(lengths: Array, directions: Array) -> Array:
    hit = jnp.isfinite(lengths) & (lengths > 0)
    return jnp.where(hit[..., None], lengths[..., None] * directions, jnp.nan)
