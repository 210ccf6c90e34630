"""Baked fields as files: numpy's `.npz`, and VTK's `.vti`, which ParaView shows."""

from __future__ import annotations

import base64
import os
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state.pytrees import Baked

_BLOCK_BYTES = 2**20
_VTK_TYPES = {"f4": "Float32", "u1": "UInt8"}


def write_npz(path: str | os.PathLike[str], baked: Baked) -> None:
    """Writes the arrays of a baked field, by their names in `Baked`, compressed.

    `hio.Baked(**numpy.load(path))` is the same field again.

    Args:
        path: The file.
        baked: The baked field of a whole map.

    Raises:
        OSError: The file cannot be written.
    """
    names = vars(baked).keys() - {"window"}  # static, and False by default
    arrays = {name: np.asarray(getattr(baked, name)) for name in sorted(names)}
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def write_vti(path: str | os.PathLike[str], baked: Baked) -> None:
    """Writes a baked field as an image of VTK, with its arrays as point data.

    They are `sdf`, `frontier` and `lower`, m, and `observed`, 0 or 1. See VTK's file formats, "XML
    file formats": serial ImageData, compressed by zlib.

    Args:
        path: The file.
        baked: The baked field.

    Raises:
        OSError: The file cannot be written.
    """
    frontier = np.asarray(baked.frontier)
    arrays = {
        "sdf": np.asarray(baked.sdf),
        "frontier": frontier,
        "lower": np.asarray(baked.lower),
        "observed": (frontier > 0).astype(np.uint8),
    }
    extent = " ".join(f"0 {count - 1}" for count in frontier.shape)
    origin = " ".join(repr(float(each)) for each in np.asarray(baked.corner_world))
    spacing = " ".join([repr(float(baked.resolution))] * 3)
    with replacing(path) as file:
        file.write(
            '<?xml version="1.0"?>\n'
            '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" '
            'header_type="UInt64" compressor="vtkZLibDataCompressor">\n'
            f'<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">\n'
            f'<Piece Extent="{extent}">\n<PointData Scalars="sdf">\n'.encode()
        )
        for name, array in arrays.items():
            kind = _VTK_TYPES[array.dtype.str[1:]]
            file.write(f'<DataArray type="{kind}" Name="{name}" format="binary">\n'.encode())
            values = array.astype(array.dtype.newbyteorder("<"), copy=False)
            for part in _encode(values.ravel(order="F")):  # x runs fastest
                file.write(part)
            file.write(b"\n</DataArray>\n")
        file.write(b"</PointData>\n</Piece>\n</ImageData>\n</VTKFile>\n")


def _encode(values: np.ndarray) -> Iterator[bytes]:
    """Compresses values in blocks; their sizes come first, and both parts are base64."""
    data = memoryview(np.ascontiguousarray(values)).cast("B")
    blocks = [
        zlib.compress(data[start : start + _BLOCK_BYTES], 6)
        for start in range(0, len(data), _BLOCK_BYTES)
    ]
    partial = len(data) % _BLOCK_BYTES
    sizes = [len(blocks), _BLOCK_BYTES, partial, *map(len, blocks)]
    yield base64.b64encode(struct.pack(f"<{len(sizes)}Q", *sizes))
    yield base64.b64encode(b"".join(blocks))
