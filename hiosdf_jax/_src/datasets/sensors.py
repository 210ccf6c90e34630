"""Depth and range images to point clouds (section III of the paper: "dense or sparse").

A cloud has one row a pixel or beam, in the order of the image, with NaN where nothing came back:
its shape then depends on the sensor alone, so that one compilation serves a stream.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def depth_to_cloud(depth: ArrayLike, intrinsics: ArrayLike) -> Array:
    """Turns depth images of a pinhole camera into clouds.

    Args:
        depth: (..., H, W) metres along the optical axis; 0, negative, NaN or inf means no return.
        intrinsics: (3, 3) pinhole matrix K in pixels, with pixel centres at integer coordinates.

    Returns:
        (..., H * W, 3) metres in the sensor frame: x right, y down, z forward; row by row of the
        image, NaN for no return.

    Raises:
        ValueError: Depth has fewer than two dimensions or intrinsics is not (3, 3).
    """
    depth, intrinsics = jnp.asarray(depth), jnp.asarray(intrinsics)
    if depth.ndim < 2:
        raise ValueError(f"depth has shape {depth.shape}, expected (..., H, W)")
    if intrinsics.shape != (3, 3):
        raise ValueError(f"intrinsics has shape {intrinsics.shape}, expected (3, 3)")
    height, width = depth.shape[-2:]
    v = (jnp.arange(height) - intrinsics[1, 2])[:, None] / intrinsics[1, 1]
    # K[0, 1] is the skew: 0 in nearly all cameras, but part of K.
    u = (jnp.arange(width) - intrinsics[0, 2] - intrinsics[0, 1] * v) / intrinsics[0, 0]
    directions = jnp.stack([u, jnp.broadcast_to(v, u.shape), jnp.ones_like(u)], axis=-1)
    flat = depth.reshape(*depth.shape[:-2], height * width)
    return _along(flat, directions.reshape(height * width, 3))


def ranges_to_cloud(ranges: ArrayLike, directions: ArrayLike) -> Array:
    """Turns one scan of a LiDAR into a cloud.

    Args:
        ranges: (...) metres along each beam; 0, negative, NaN or inf means no return.
        directions: (..., 3) unit directions of the beams in the sensor frame.

    Returns:
        (n, 3) metres in the sensor frame, n the number of beams; NaN for no return.

    Raises:
        ValueError: Directions is not (*ranges.shape, 3).
    """
    ranges, directions = jnp.asarray(ranges), jnp.asarray(directions)
    expected = (*ranges.shape, 3)
    if directions.shape != expected:
        raise ValueError(
            f"directions has shape {directions.shape}, expected {expected}, "
            f"one unit vector for each of ranges {ranges.shape}"
        )
    return _along(ranges.reshape(-1), directions.reshape(-1, 3))


def _along(lengths: Array, directions: Array) -> Array:
    hit = jnp.isfinite(lengths) & (lengths > 0)
    return jnp.where(hit[..., None], lengths[..., None] * directions, jnp.nan)
