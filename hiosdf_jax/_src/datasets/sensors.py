"""Converts depth and range images to point clouds (section III of the paper, "dense or sparse").

A cloud has one row per pixel or ray, in the order of the image, and NaN where there is no return.
Its shape depends on the sensor alone, so one compilation serves a stream.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from hiosdf_jax._src.numerics.intake import as_array, is_traced

_ZERO = 1e-6  # of a camera matrix; files have few digits


def depth_to_cloud(depth: ArrayLike, intrinsics: ArrayLike) -> Array:
    """Converts depth images of a pinhole camera to clouds.

    Args:
        depth: (..., H, W) m along the optical axis; 0, negative, NaN or inf means no return.
        intrinsics: (3, 3) pinhole matrix K in pixels, with pixel centers at integer coordinates.

    Returns:
        (..., H * W, 3) m, sensor frame (x right, y down, z forward), row by row of the image; NaN
        for no return.

    Raises:
        ValueError: Depth has fewer than two dimensions, or intrinsics is not a pinhole matrix.
            Inside jit only its shape is checked.

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
    if not is_traced(intrinsics):
        check_camera("intrinsics", jax.device_get(intrinsics))
    height, width = depth.shape[-2:]
    v = (jnp.arange(height) - intrinsics[1, 2])[:, None] / intrinsics[1, 1]
    # K[0, 1] is the skew, 0 for nearly all cameras but part of K.
    u = (jnp.arange(width) - intrinsics[0, 2] - intrinsics[0, 1] * v) / intrinsics[0, 0]
    directions = jnp.stack([u, jnp.broadcast_to(v, u.shape), jnp.ones_like(u)], axis=-1)
    flat = depth.reshape(*depth.shape[:-2], height * width)
    return _along(flat, directions.reshape(height * width, 3))


def check_camera(name: str, matrix: np.ndarray) -> None:
    """Checks a pinhole matrix.

    Args:
        name: Name of the matrix in error messages.
        matrix: (3, 3) K, pixels.

    Raises:
        ValueError: It is not finite, a focal length is not a positive float32 at full precision,
            or the zeros and the 1 of a pinhole matrix are something else.
    """
    with np.errstate(over="ignore", under="ignore"):
        rounded = matrix.astype(np.float32)
    fault = None
    if not np.isfinite(rounded).all():
        fault = "finite numbers"
    elif np.abs(rounded[2, :2]).max() > _ZERO:
        fault = "0, 0, 1 in the last row; is it transposed?"
    elif not (rounded[[0, 1], [0, 1]] >= np.finfo(np.float32).tiny).all():
        fault = "focal lengths > 0"
    elif np.abs(rounded[2, 2] - 1) > _ZERO:
        fault = "0, 0, 1 in the last row; is it scaled?"
    elif np.abs(rounded[1, 0]) > _ZERO:
        fault = "0 left of the second focal length"
    if fault is not None:
        raise ValueError(f"{name} is {matrix.tolist()}, expected {fault}")


def ranges_to_cloud(ranges: ArrayLike, directions: ArrayLike) -> Array:
    """Converts one scan of a LiDAR to a cloud.

    Args:
        ranges: (...) m along each ray; 0, negative, NaN or inf means no return.
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
