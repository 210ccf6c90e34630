"""Reads depth image files as clouds.

Pillow decodes the 16-bit PNGs; matplotlib depends on it anyway.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence

import jax
import numpy as np

from hiosdf_jax._src.datasets import sensors
from hiosdf_jax._src.datasets.files import most_returns, open_regular, parsing

_to_cloud = jax.jit(sensors.depth_to_cloud)


def pinhole(intrinsics: Sequence[float], source: object) -> np.ndarray:
    """Makes a camera matrix.

    Args:
        intrinsics: fx, fy, cx, cy in pixels, with pixel centers at integer coordinates.
        source: Where the intrinsics come from, for the message.

    Returns:
        (3, 3) float64, K.

    Raises:
        ValueError: There are not four, one is not finite, or a focal length is not positive.
    """
    values = np.asarray(intrinsics, float)
    if values.shape != (4,):
        raise ValueError(
            f"{source}: intrinsics are {values.tolist()}, expected fx, fy > 0, cx, cy in pixels"
        )
    fx, fy, cx, cy = values
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    sensors.check_camera(f"{source}: camera matrix of fx, fy, cx, cy", matrix)
    return matrix


def read_depth(
    path: str | os.PathLike[str],
    scale: float,
    matrix: np.ndarray,
    size: tuple[int, int] | None = None,
) -> np.ndarray:
    """Reads a depth image as a cloud.

    Args:
        path: PNG with one 16-bit channel; 0 is not a return.
        scale: m = value / scale, along the optical axis.
        matrix: (3, 3) K, pixels.
        size: Width and height that K belongs to; by default the size is not checked.

    Returns:
        (H * W, 3) float32 m, camera frame (x right, y down, z forward), NaN for no return.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not such an image; the message names it.
    """
    from PIL import Image

    with open_regular(path) as file, parsing(path, "PNG image"):
        # From memory: Pillow asks a file for as many bytes as a chunk of it declares.
        content = file.read()
        image = Image.open(io.BytesIO(content), formats=("PNG",))
        width, height = image.size
        most = most_returns(len(content))
        if width * height > most:  # before a pixel is decoded
            raise ValueError(f"{width} x {height} pixels, expected at most {most}")
        raw = np.asarray(image)
    if raw.dtype not in (np.uint16, np.int32) or raw.ndim != 2:  # int32 is Pillow's mode "I"
        raise ValueError(
            f"{path}: image of {raw.dtype} with shape {raw.shape}, expected one 16-bit channel"
        )
    if size is not None and raw.shape != size[::-1]:
        raise ValueError(
            f"{path}: image of {raw.shape[1]} x {raw.shape[0]} pixels, expected {size[0]} x "
            f"{size[1]} as in the intrinsics"
        )
    depth = raw.astype(np.float32) / np.float32(scale)
    return np.asarray(_to_cloud(depth, matrix.astype(np.float32)))
