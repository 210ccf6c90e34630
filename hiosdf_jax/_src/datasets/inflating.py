"""Limits on what compressed data may become: a few bytes can inflate to gigabytes."""

from __future__ import annotations

import bz2
import os
import threading
from collections.abc import Callable
from typing import Any, BinaryIO

# Data may inflate to this many times the size that they have in the file. Recordings of depth
# cameras and LiDARs shrink to a tenth or more; the best of the benchmarks to an eighth.
_MOST_INFLATION = 25
_SMALL_BYTES = 64 << 20  # always allowed

_patching = threading.Lock()


def most_inflated(file_bytes: int) -> int:
    """Limits data that are held in memory at once.

    Args:
        file_bytes: Their size in the file.

    Returns:
        The most bytes that they may inflate to: 64 MB, or 25 for each byte.
    """
    return max(_SMALL_BYTES, _MOST_INFLATION * file_bytes)


def inflate(start: Callable[[], Any], data: bytes) -> bytes:
    """Inflates data, and stops where they become too large.

    Args:
        start: Makes a decompressor, such as `bz2.BZ2Decompressor`.
        data: What it wrote; several streams may follow one another.

    Returns:
        The inflated data.

    Raises:
        ValueError: They are larger than `most_inflated` allows.
        EOFError: They are cut off.
        Exception: Whatever the decompressor raises for data that it cannot read.
    """
    parts, most, rest = [], most_inflated(len(data)), data
    while rest:
        decompressor = start()
        part = decompressor.decompress(rest, max_length=most + 1)
        most -= len(part)
        if most < 0:
            raise ValueError(
                f"{len(data)} bytes inflate to more than {most_inflated(len(data))}, the most "
                "that is allowed"
            )
        if not decompressor.eof:
            raise EOFError("compressed data are cut off")
        parts.append(part)
        rest = decompressor.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


def limit_rosbags() -> None:
    """Makes rosbags inflate chunks and messages by `inflate`, for the whole process.

    By default rosbags inflates a chunk of any size before it can be checked.
    """
    import lz4.frame
    import rosbags.rosbag1.reader
    import rosbags.rosbag2.reader
    import rosbags.rosbag2.storage_mcap

    ros1: Any = rosbags.rosbag1.reader
    ros2: Any = rosbags.rosbag2.reader
    mcap: Any = rosbags.rosbag2.storage_mcap
    with _patching:
        if isinstance(ros2.zstd, _LimitedZstd):
            return
        zstd = _LimitedZstd(ros2.zstd)

        def lz4_inflate(data: bytes, *_: Any) -> bytes:
            return inflate(lz4.frame.LZ4FrameDecompressor, data)

        ros1.decompressors["lz4"] = mcap.DECOMPRESSORS["lz4"] = lz4_inflate
        ros1.decompressors["bz2"] = lambda data: inflate(bz2.BZ2Decompressor, data)
        mcap.DECOMPRESSORS["zstd"] = lambda data, _: zstd.decompress(data)
        ros2.zstd = zstd


class _LimitedZstd:
    """The part of the module `zstd` that rosbags reads bags with."""

    def __init__(self, module: Any) -> None:
        self._module = module

    def decompress(self, data: bytes) -> bytes:
        return inflate(self._module.ZstdDecompressor, data)

    def open(self, file: BinaryIO, mode: str) -> _LimitedFile:
        most = most_inflated(os.fstat(file.fileno()).st_size)
        return _LimitedFile(self._module.open(file, mode), most)


class _LimitedFile:
    """A compressed file that may be read up to a size."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._left = file, most

    def __enter__(self) -> _LimitedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("it inflates to more than is allowed for a file of its size")
        return data
