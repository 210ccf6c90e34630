"""Reads untrusted `.npz` files: each entry is checked before it is inflated.

An entry of a few bytes can inflate to gigabytes. The header inside it gives its type and shape, and
only an entry of the right size is read. Nothing is unpickled.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from contextlib import AbstractContextManager
from types import TracebackType
from typing import NamedTuple

import numpy as np

from hiosdf_jax._src.datasets.files import open_regular, parsing
from hiosdf_jax._src.datasets.inflating import most_inflated

_Path = str | os.PathLike[str]

_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1  # bit of an entry's flags
_HEADER_BYTES = 10_000 + 12  # numpy's own limit, with magic and length
_CHUNK_BYTES = 1 << 20


class Array(NamedTuple):
    """What an entry says of itself.

    Attributes:
        shape: Its shape.
        dtype: Its type: numbers, booleans or text.
        is_fortran: Its first axis varies fastest.
        start: Bytes before its first element.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    is_fortran: bool
    start: int


class Archive:
    """An open `.npz` file; a context manager."""

    def __init__(self, path: _Path) -> None:
        """Opens a file and checks its table of contents.

        Args:
            path: The file.

        Raises:
            FileNotFoundError: There is no such file.
            IsADirectoryError: It is a folder.
            ValueError: It is not such a file, has an entry twice, or one that is encrypted or
                compressed in a way that numpy does not write. The message names the file.
        """
        self.path = path
        self._file = open_regular(path)
        self._most = self._left = most_inflated(os.fstat(self._file.fileno()).st_size)
        try:
            with parsing(path, "npz file"):
                if self._file.read(6) == b"\x93NUMPY":
                    raise ValueError("it holds a single array, expected named arrays")
                self._zip = zipfile.ZipFile(self._file)
                self._entries: dict[str, zipfile.ZipInfo] = {}
                for entry in self._zip.infolist():
                    name = entry.filename.removesuffix(".npy")
                    if name in self._entries:
                        raise ValueError(f"it has {name!r} twice")
                    if entry.flag_bits & _ENCRYPTED:
                        raise ValueError(f"{name!r} is encrypted")
                    if entry.compress_type not in _COMPRESSIONS:
                        raise ValueError(f"{name!r} has compression {entry.compress_type}")
                    self._entries[name] = entry
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Archive:
        """Returns the archive itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Closes the file."""
        self._file.close()

    @property
    def names(self) -> set[str]:
        """The names of all arrays."""
        return set(self._entries)

    def describe(self, name: str) -> Array:
        """Reads the header of an array, without the array.

        Raises:
            ValueError: It has none, is not an array of numbers, booleans or text, or its size is
                not that of the entry. The message names the file and the array.
        """
        with self._reading(name):
            return self._open(name)[0]

    def read(self, name: str, *, whole: bool = False) -> np.ndarray:
        """Reads an array.

        Args:
            name: Its name.
            whole: Read it whatever its size, which the caller has checked. Otherwise all arrays
                that are read must together not be larger than `most_inflated` allows.

        Returns:
            The array.

        Raises:
            ValueError: As for `describe`; or it is damaged or too large. The message names the
                file and the array.
        """
        with self._reading(name):
            array, file, data = self._open(name)
            count, size = math.prod(array.shape), math.prod(array.shape) * array.dtype.itemsize
            if not whole:
                if size > self._left:
                    raise ValueError(
                        f"{array.dtype} {array.shape} takes {size:.3g} bytes, expected at most "
                        f"{self._left:.3g} of the {self._most:.3g} for a file of this size"
                    )
                self._left -= size
            values = np.empty(count, array.dtype)
            target = memoryview(values.view(np.uint8))
            target[: len(data)] = data
            filled = len(data)
            while filled < size:
                part = file.read(min(_CHUNK_BYTES, size - filled))
                if not part:
                    raise EOFError("it is cut off")
                target[filled : filled + len(part)] = part
                filled += len(part)
            file.read(1)  # at its end, the checksum of the entry is compared
            return values.reshape(array.shape, order="F" if array.is_fortran else "C")

    def _open(self, name: str) -> tuple[Array, zipfile.ZipExtFile, bytes]:
        """The header of an array; its file, and the first data, which were read with the header."""
        entry = self._entries[name]
        file: zipfile.ZipExtFile = self._zip.open(entry)  # pyright: ignore[reportAssignmentType]
        first = b""
        while len(first) < _HEADER_BYTES and (part := file.read(_HEADER_BYTES - len(first))):
            first += part
        header = io.BytesIO(first)
        version = np.lib.format.read_magic(header)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, is_fortran, dtype = reader(header)
        plain = dtype.kind in "fiubU" and dtype.itemsize > 0
        if not plain or min(shape, default=0) < 0:
            raise ValueError(f"it is {dtype} {shape}, expected numbers")
        array = Array(shape, dtype, is_fortran, header.tell())
        size = math.prod(shape) * dtype.itemsize
        if array.start + size != entry.file_size:
            raise ValueError(
                f"{dtype} {shape} takes {size} bytes, but the entry has "
                f"{entry.file_size - array.start}"
            )
        return array, file, first[array.start :]

    def _reading(self, name: str) -> AbstractContextManager[None]:
        return parsing(f"{self.path}: key {name!r}", "array")
