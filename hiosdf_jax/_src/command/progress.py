"""How far a map has come in its stream, kept in its file so that a run can be resumed."""

from __future__ import annotations

import hashlib
import os
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.mapping import checkpoint
from hiosdf_jax._src.state.pytrees import MapState


class Progress(NamedTuple):
    """How far a map has come in its stream.

    Attributes:
        next_frame: Index of the first frame of the stream that has not been read yet.
        digest: Digest of all frames before it, by `FrameDigest`.
        points_used: Number of fused points, over all frames.
        points_outside: Number of points in range but outside the bounds, over all frames.
    """

    next_frame: int = 0
    digest: str = ""
    points_used: int = 0
    points_outside: int = 0


class SavedMap(NamedTuple):
    """A map that a run can resume.

    Attributes:
        state: The map.
        progress: How far it has come.
        seed: Seed of the run.
        held_out: Whether the run scores the map on frames that the map is not given.
    """

    state: MapState
    progress: Progress
    seed: int
    held_out: bool


class FrameDigest:
    """Digest of the frames of a stream, which identifies the stream."""

    def __init__(self) -> None:
        """Begins before the first frame."""
        self._hash = hashlib.blake2b(digest_size=16)

    def add(self, cloud: np.ndarray | None, pose: np.ndarray | None) -> None:
        """Adds the next frame; None and None for one that cannot be used."""
        for array in (cloud, pose):
            array = np.asarray(np.nan if array is None else array)
            self._hash.update(f"{array.dtype}{array.shape}".encode())
            self._hash.update(np.ascontiguousarray(array))

    def text(self) -> str:
        """The digest of the frames so far."""
        return self._hash.hexdigest()


def save_map(path: str | os.PathLike[str], saved: SavedMap) -> None:
    """Writes a map that a run can resume; `hiosdf_jax.load` reads it like any other.

    Args:
        path: The file.
        saved: The map.

    Raises:
        OSError: The file cannot be written.
    """
    notes = saved.progress._asdict() | {"seed": saved.seed, "held_out": saved.held_out}
    checkpoint.save_with_progress(path, saved.state, notes)


def _in_range(notes: dict[str, int]) -> bool:
    counts = {name: value for name, value in notes.items() if name not in ("digest", "held_out")}
    return min(counts.values()) >= 0 and notes["seed"] < 2**32


def load_map(path: str | os.PathLike[str]) -> SavedMap:
    """Reads a map that `save_map` wrote.

    Args:
        path: The file.

    Returns:
        The map.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is not a map, or does not say how far it has come.
    """
    state = checkpoint.load(path)
    notes = checkpoint.read_progress(path)
    expected = Progress()._asdict() | {"seed": 0, "held_out": False}
    fits = isinstance(notes, dict) and {name: type(each) for name, each in notes.items()} == {
        name: type(each) for name, each in expected.items()
    }
    if not fits or not _in_range(notes):
        raise ValueError(
            f"{path}: the file does not say how far the map has come in its stream, expected one "
            "that the hiosdf command wrote"
        )
    seed, held_out = notes.pop("seed"), notes.pop("held_out")
    return SavedMap(state, Progress(**notes), seed, held_out)
