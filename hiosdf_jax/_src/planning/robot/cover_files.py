"""Covers of geoms in a file, so that a robot is covered once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence

import numpy as np

from hiosdf_jax._src.datasets.archive import Archive
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.planning.robot.cover import SphereCover

_Path = str | os.PathLike[str]

_FORMAT = "hiosdf_jax covers"
_VERSION = 1  # changes with the covers that the same geoms get
_NAMES = {"format", "key", "counts", "centers_body", "radii"}


def cache_key(tolerance: float, geoms: Sequence[Sequence[np.ndarray]]) -> str:
    """Hashes all that covers depend on.

    Args:
        tolerance: m.
        geoms: Arrays that describe each geom.

    Returns:
        A hexadecimal digest.
    """
    digest = hashlib.sha256(f"{_VERSION} {tolerance!r}".encode())
    for geom in geoms:
        for array in geom:
            digest.update(f" {array.dtype.str} {array.shape} ".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(b";")
    return digest.hexdigest()


def read_covers(path: _Path, key: str, count: int) -> list[SphereCover] | None:
    """Reads covers.

    Args:
        path: The file.
        key: Key of the covers that are needed.
        count: Number of geoms.

    Returns:
        The covers, or None if there is no file or it holds others.

    Raises:
        ValueError: The file is of another kind, or damaged.
        OSError: It cannot be read.
    """
    if not os.path.exists(path):
        return None
    with Archive(path) as archive:
        if archive.names != _NAMES or str(archive.read("format")) != _FORMAT:
            raise ValueError(f"{os.fspath(path)} holds no covers, expected another file name")
        if str(archive.read("key")) != key:
            return None
        counts, centers, radii = map(archive.read, ("counts", "centers_body", "radii"))
    is_cover = (
        counts.shape == (count,)
        and (counts > 0).all()
        and centers.shape == (counts.sum(), 3)
        and radii.shape == (counts.sum(),)
        and np.isfinite(centers).all()
        and ((radii > 0) & np.isfinite(radii)).all()
    )
    if not is_cover:
        raise ValueError(f"{os.fspath(path)} holds covers that are damaged; remove the file")
    rows = np.cumsum(counts)[:-1]
    return list(zip(np.split(centers, rows), np.split(radii, rows), strict=True))


def write_covers(path: _Path, key: str, covers: Sequence[SphereCover]) -> None:
    """Writes covers to a file that is replaced whole.

    Args:
        path: The file; its folder must exist.
        key: Their key.
        covers: The cover of each geom.

    Raises:
        OSError: The file cannot be written.
    """
    arrays = {
        "format": np.asarray(_FORMAT),
        "key": np.asarray(key),
        "counts": np.asarray([len(radii) for _, radii in covers]),
        "centers_body": np.concatenate([centers for centers, _ in covers]),
        "radii": np.concatenate([radii for _, radii in covers]),
    }
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
