"""Crafted and damaged .npz files: refused by name, before memory is taken for them."""

import io
import json
import os
import re
import struct
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from test_datasets_npz import DEPTH

import hiosdf_jax as hio
from hiosdf_jax._src.datasets.archive import Archive
from hiosdf_jax.datasets import NpzStream

BOMB_BYTES = 1 << 27


def entry(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def header(shape, descr="<f4", version=1):
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H", len(text)) + text


def write_entries(path, entries, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, content in entries.items():
            file.writestr(name, content)


def read_entries(path):
    with zipfile.ZipFile(path) as file:
        return {each.filename: file.read(each) for each in file.infolist()}


def write_bomb(path, entries, name, before):
    """Replaces an entry by zeros that take a thousandth of their size, after some bytes."""
    rest = {each: content for each, content in entries.items() if each != name}
    write_entries(path, rest)
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open(name, "w", force_zip64=True) as bomb,
    ):
        bomb.write(before)
        for _ in range(BOMB_BYTES >> 24):
            bomb.write(bytes(1 << 24))


def patch_flags(path, offsets, value):
    """Changes a number of two bytes of all entries, in both places that have it."""
    data = bytearray(path.read_bytes())
    for signature, offset in zip((b"PK\x03\x04", b"PK\x01\x02"), offsets, strict=True):
        place = data.find(signature)
        while place >= 0:
            data[place + offset : place + offset + 2] = struct.pack("<H", value)
            place = data.find(signature, place + 4)
    path.write_bytes(data)


DEEP = b"(" * 90 + b")" * 90
HEADERS = {
    "no magic": b"plain text",
    "nothing": b"",
    "other version": b"\x93NUMPY\x09\x00" + bytes(100),
    "1e12 numbers": header((10**6, 10**6)),
    "a negative shape": header((-1, 4)),
    "a shape of words": header("'abc'"),
    "an endless header": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{",
    "code": b"\x93NUMPY\x01\x00" + struct.pack("<H", 24) + b"__import__('os').abort()",
    "an open bracket": b"\x93NUMPY\x01\x00" + struct.pack("<H", 4) + b"{'a'",
    "deep brackets": b"\x93NUMPY\x01\x00" + struct.pack("<H", len(DEEP)) + DEEP,
    "too little data": header((2, 2)) + bytes(15),
    "too much data": header((2, 2)) + bytes(17),
    "objects": entry(np.array([None, {}])),
    "parts": header((2,), [("x", "<f4")]) + bytes(8),
    "text of 4 GB": header((1,), "<U1000000000") + bytes(4),
    "no bytes": header((1000000,), "<U0"),
}


@pytest.fixture(scope="module")
def honest(empty_map, tmp_path_factory):
    """An honest map and an honest stream: reader, entries, an array, and the peak of memory."""
    folder = tmp_path_factory.mktemp("honest")
    hio.save(folder / "map.npz", empty_map)
    np.savez_compressed(folder / "stream.npz", **DEPTH)
    kinds = {}
    for name, read, array in (("map", hio.load, "grid.hits"), ("stream", NpzStream, "depth")):
        path = folder / f"{name}.npz"
        read(path)
        kinds[name] = read, read_entries(path), f"{array}.npy", peak_of(read, path)
    return kinds


def peak_of(read, path):
    tracemalloc.start()
    try:
        read(path)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


def check_refused(honest, kind, path, message=""):
    read, _, _, usual = honest[kind]
    tracemalloc.start()
    with pytest.raises(ValueError, match=message) as error:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    assert peak <= 2 * usual


KINDS = pytest.mark.parametrize("kind", ["map", "stream"])


@KINDS
@pytest.mark.parametrize("content", HEADERS.values(), ids=HEADERS.keys())
def test_crafted_entries(honest, kind, content, tmp_path):
    _, entries, name, _ = honest[kind]
    path = tmp_path / "crafted.npz"
    write_entries(path, entries | {name: content})
    check_refused(honest, kind, path, name.removesuffix(".npy"))
    write_entries(path, entries | {name: content}, zipfile.ZIP_STORED)
    check_refused(honest, kind, path)


@KINDS
def test_bombs(honest, kind, tmp_path):
    _, entries, name, _ = honest[kind]
    path = tmp_path / "bomb.npz"
    for before in (b"", header((1 << 10, 1 << 10, 1 << 5)), entries[name]):
        write_bomb(path, entries, name, before)
        check_refused(honest, kind, path, name.removesuffix(".npy"))
    write_bomb(path, entries, "poses.npy", header((1 << 21, 4, 4)))
    check_refused(honest, kind, path, "poses")
    write_bomb(path, entries, "header.npy", header((), "<U33554432"))
    if kind == "map":
        check_refused(honest, kind, path, "header")


@KINDS
def test_crafted_tables_of_contents(honest, kind, tmp_path):
    _, entries, name, _ = honest[kind]
    path = tmp_path / "crafted.npz"
    with zipfile.ZipFile(path, "w") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for each in (*entries, name):
            file.writestr(each, entries[each])
    check_refused(honest, kind, path, "twice")
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        write_entries(path, entries, method)
        check_refused(honest, kind, path, f"compression {method}")
    write_entries(path, entries)
    patch_flags(path, (8, 10), 99)
    check_refused(honest, kind, path, "compression 99")
    write_entries(path, entries)
    patch_flags(path, (6, 8), 1)
    check_refused(honest, kind, path, "encrypted")
    write_entries(path, entries, zipfile.ZIP_STORED)
    whole = path.read_bytes()
    place = whole.index(entries[name]) + len(entries[name]) - 3
    for damaged in (
        b"",
        b"not a zip file",
        entries[name],
        whole[: len(whole) // 2],
        whole[len(whole) // 2 :],
        whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :],  # the checksum is wrong
    ):
        path.write_bytes(damaged)
        check_refused(honest, kind, path)


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    for read in (hio.load, NpzStream):
        for path in (tmp_path / "pipe.npz", "/dev/zero"):
            with pytest.raises(ValueError, match="is a pipe or a device"):
                read(path)
        with pytest.raises(IsADirectoryError):
            read(tmp_path)
        for path in (None, 5, "a\0b"):
            with pytest.raises(ValueError, match=r"path is .*, expected the name of a file"):
                read(path)


def test_arrays_come_out_as_they_went_in(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "large": rng.normal(size=(700, 400)),
        "fortran": np.asfortranarray(rng.normal(size=(5, 6, 7))),
        "big": rng.integers(0, 99, (3, 4)).astype(">i4"),
        "flags": rng.random(9) > 0.5,
        "text": np.array("öl"),
        "none": np.zeros((0, 3)),
        "one": np.float16(2),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        with Archive(tmp_path / "a.npz") as archive:
            assert archive.names == set(arrays)
            for name, array in arrays.items():
                found = archive.read(name)
                assert found.dtype == array.dtype and found.shape == array.shape
                np.testing.assert_array_equal(found, array)


def test_a_large_array_needs_a_large_file(tmp_path):
    path = tmp_path / "zeros.npz"
    np.savez_compressed(path, zeros=np.zeros(10_000_000))
    with Archive(path) as archive:
        with pytest.raises(ValueError, match=r"float64 \(10000000,\) takes 8e\+07 bytes, expected"):
            archive.read("zeros")
        assert not archive.read("zeros", whole=True).any()


def test_all_arrays_together_need_a_large_file(tmp_path):
    path = tmp_path / "zeros.npz"
    np.savez_compressed(path, **{name: np.zeros(4_000_000) for name in "abc"})
    with Archive(path) as archive:
        assert not archive.read("a").any() and not archive.read("b").any()
        with pytest.raises(
            ValueError, match=r"takes 3.2e\+07 bytes, expected at most 3.11e\+06 of"
        ):
            archive.read("c")


def edited(entries, **changes):
    head = json.loads(str(np.load(io.BytesIO(entries["header.npy"]))))
    config = head["config"] | changes.pop("config", {})
    head = head | {"config": config} | changes
    head = {key: value for key, value in head.items() if value is not None}
    head["config"] = {key: value for key, value in config.items() if value is not None}
    return entries | {"header.npy": entry(np.array(json.dumps(head)))}


def test_every_field_of_the_header_is_required(honest, tmp_path):
    _, entries, _, _ = honest["map"]
    path = tmp_path / "map.npz"
    for name in hio.Config.__dataclass_fields__:
        write_entries(path, edited(entries, config={name: None}), zipfile.ZIP_STORED)
        check_refused(honest, "map", path, f"no valid configuration: it lacks .*'{name}'")
    write_entries(path, edited(entries, config={"color": 1}), zipfile.ZIP_STORED)
    check_refused(honest, "map", path, "the unknown .*'color'")
    for changes, message in (
        ({"format": None}, "it has no such header"),
        ({"version": None}, "its header lacks .*version"),
        ({"key": None}, "its header lacks .*key"),
        ({"key": "md5"}, "has the key 'md5'"),
        ({"version": True}, "format version True, expected 2 to 7"),
        ({"version": 4.0}, "format version 4.0, expected 2 to 7"),
        ({"version": 1}, "format version 1, expected 2 to 7; .* made again from its recording"),
        ({"config": {"bounds": [[0, 0, 0], [1e9, 1, 1]]}}, "no valid configuration: .* 100 km"),
        ({"config": {"voxel_size": "0.1"}}, "no valid configuration: Config.voxel_size is '0.1'"),
        ({"config": {"bounds": [[0, 0, 0], [60, 60, 60]]}}, r"grid\.\S+ of \S+ .*expected"),
    ):
        write_entries(path, edited(entries, **changes), zipfile.ZIP_STORED)
        check_refused(honest, "map", path, message)
    for name in ("grid.color", "../../outside", "two\nlines", "\x1b[31mred"):
        write_entries(path, entries | {f"{name}.npy": entry(np.zeros(3))}, zipfile.ZIP_STORED)
        shown = name if name.isprintable() else re.escape(repr(name))
        check_refused(honest, "map", path, f"has the unknown array {shown}")


def test_values_that_no_map_has_are_refused(honest, tmp_path):
    _, entries, _, _ = honest["map"]
    path = tmp_path / "map.npz"
    weights = next(name for name in entries if name.startswith("network.params"))
    second_moment = next(name for name in entries if name.startswith("network.optimizer.0.nu."))
    for name, value, message in (
        (weights, np.nan, "has network.params.* with values that are not finite"),
        ("grid.surface.mean.npy", np.inf, "has grid.surface.mean with values that are not finite"),
        ("grid.surface.mean.npy", 2.0, "has grid.surface.mean from .* to 2.0, expected -1 to 1"),
        ("grid.hits.npy", -1.0, "has grid.hits from -1.0 to"),
        ("grid.surface.sdf.npy", 6e4, "has grid.surface.sdf from"),
        ("grid.surface.side.npy", 4, "has grid.surface.side from .* to 4, expected"),
        ("optimism.npy", -1e9, "has optimism from -1000000000.0 to"),
        ("grid.surface.nearest.npy", 127, "has grid.surface.nearest without a patch there"),
        ("grid.surface.nearest.npy", 0, "has grid.surface.nearest without a patch there"),
        ("grid.surface.sdf.npy", -0.5, "has grid.surface.sdf without a patch, expected 1"),
        ("grid.surface.side.npy", 1, "has grid.surface.sdf without a patch, expected 1"),
        ("grid.surface.doubt.npy", 100.0, "has grid.surface.doubt beyond 1"),
        ("grid.surface.frontier.npy", -128, "has grid.surface.frontier from -128 to"),
        ("grid.surface.frontier.npy", 127, "has grid.surface.frontier of the wrong sign"),
        ("grid.change.npy", -128, "has grid.change from -128 to"),
        ("grid.change.npy", 9, "has grid.change from 0 to 9, expected -72 to 8"),
        ("optimism.npy", 1e30, "has optimism from 1.* to .*, expected 0 to 424"),
        ("report.refused_in_row.npy", -1, "has report.refused_in_row from -1 to"),
        ("report.refused_in_row.npy", 2**31 - 1, "has report.refused_in_row from"),
        ("report.flags.npy", 2**31, "has report.flags from"),
        ("report.update_flags.npy", 2**31, "has report.update_flags from"),
        ("report.points_used.npy", -1, "has report.points_used from -1 to"),
        ("report.sdf_loss.npy", -1.0, "has report.sdf_loss from -1.0 to"),
        (second_moment, -1.0, "has network.optimizer.0.nu.* from -1.0 to"),
        ("updates.npy", -1, "has updates from -1 to -1, expected 0"),
        (weights, 3e38, "has network.params.* from .* to 3"),
        ("network.origin_world.npy", 3e38, "has network.origin_world from .* to 3"),
    ):
        array = np.load(io.BytesIO(entries[name]))
        array[...] = np.where(np.arange(array.size).reshape(array.shape) == 0, value, array)
        write_entries(path, entries | {name: entry(array)}, zipfile.ZIP_STORED)
        check_refused(honest, "map", path, message)
