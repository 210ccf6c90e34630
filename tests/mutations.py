"""Mutated recordings, maps and meshes, read in a process of its own with little memory.

    python tests/mutations.py FIRST COUNT

reads the cases FIRST, FIRST + 1, ... and prints a summary as JSON. Each case damages one file of an
honest recording. A reader must then give a stream, or say in a ValueError or an OSError which file
is wrong; within 10 s of the processor, and without much memory.
"""

import json
import os
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np

SECONDS = 10  # of the processor
WAITING_SECONDS = 60  # for a file that never ends, on a machine that does other things, too
MEMORY_MB = 500
_ADDRESSES_MB = 1500  # threads and compilers reserve addresses that they never touch

NASTY = [b"1e400", b"nan", b"-1", b"0", b"99999999999999999999", b"1e-320", b"-inf", b"65536"]
NASTY += [b"4294967295", b"2147483648", b"[" * 3000, b"(" * 150, b"\xff\xfe", b"\0", b"'", b""]
NASTY += [b"1e27", b"1e8", b"9" * 5000, b"0x10", b"1_0", b"true", b"null", b"\n", b" "]


class Hang(BaseException):
    """A reader took too long; no `except Exception` may swallow this."""


def damage(data, rng):
    """Changes some bytes."""
    kind = rng.integers(9)
    place, other = np.sort(rng.integers(0, len(data) + 1, 2))
    if rng.random() < 0.5:  # headers come first
        place = min(place, int(rng.integers(0, 300)))
    if kind == 0:
        return data[:place]
    if kind == 1:
        return data[:place] + data[other:]
    if kind == 2:
        return data[:other] + data[place:]
    if kind == 3:
        return data[:place] + rng.bytes(int(rng.integers(1, 9))) + data[place:]
    if kind == 4:
        return data[:place] + bytes(int(other - place)) + data[other:]
    if kind == 5:
        changed = bytearray(data)
        for _ in range(int(rng.integers(1, 5))):
            if changed:
                changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    if kind == 6:
        value = struct.pack("<q", int(rng.choice([-1, 0, 1 << 31, 1 << 62, 1000, (1 << 32) - 1])))
        size = int(rng.choice([1, 2, 4, 8]))
        return data[:place] + value[:size] + data[place + size :]
    words = list(re.finditer(rb"-?\d[\d.e+-]*|[A-Za-z_]+", data[:4000]))
    if not words:
        return data[:place]
    word = words[int(rng.integers(len(words)))]
    nasty = NASTY[int(rng.integers(len(NASTY)))]
    return data[: word.start()] + nasty + data[word.end() :]


def damage_archive(data, rng, folder):
    """Changes an entry of an npz file, whose checksums stay right."""
    path = folder / "entries.tmp"
    path.write_bytes(data)
    with zipfile.ZipFile(path) as file:
        entries = {entry.filename: file.read(entry) for entry in file.infolist()}
    name = list(entries)[int(rng.integers(len(entries)))]
    entries[name] = damage(entries[name], rng)
    kind = rng.choice(
        [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2], p=[0.4, 0.5, 0.1]
    )
    with zipfile.ZipFile(path, "w", int(kind)) as file:
        for each, content in entries.items():
            file.writestr(each, content)
        if rng.random() < 0.1:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                file.writestr(name, content)
    changed = path.read_bytes()
    path.unlink()
    return changed


def damage_image(data, rng):
    """Changes a chunk of a PNG file, whose checksums stay right."""
    chunks, place = [], 8
    while place + 8 <= len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + size]))
        place += 12 + size
    k = int(rng.integers(len(chunks)))
    tag, body = chunks[k]
    if tag == b"IDAT" and rng.random() < 0.5:
        body = zlib.compress(damage(zlib.decompress(body), rng))
    else:
        body = damage(body, rng)
    chunks[k] = tag, body
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + tag + body + struct.pack(">I", zlib.crc32(tag + body))
        for tag, body in chunks
    )


def mutate(path, rng, scratch):
    """Damages one file, or puts something else in its place."""
    data = path.read_bytes()
    if rng.random() < 0.04:
        path.unlink()
        kind = rng.integers(3)
        if kind == 1:
            path.mkdir()
        elif kind == 2:
            os.mkfifo(path)
        return
    special = rng.random() < 0.7
    if special and path.suffix == ".npz":
        changed = damage_archive(data, rng, scratch)
    elif special and path.suffix == ".png":
        changed = damage_image(data, rng)
    else:
        changed = damage(data, rng)
    path.write_bytes(changed)


def restore(path, data):
    if path.is_dir():
        path.rmdir()
    path.unlink(missing_ok=True)
    path.write_bytes(data)


def write_recordings(folder):
    """Writes an honest recording of each kind; returns {name: (path, function that reads it)}."""
    import jax
    import test_datasets_npz as npz
    import trimesh
    from recordings import write_scannet, write_tum
    from test_datasets_clouds import write_clouds, write_poses
    from test_datasets_kitti import write_kitti
    from test_datasets_replicacad import write_replicacad
    from test_datasets_rosbag import write_bag

    import hiosdf_jax as hio
    from hiosdf_jax import datasets, scoring

    found = {}
    for name, arrays in (("depth", npz.DEPTH), ("range", npz.RANGE), ("points", npz.POINTS)):
        (folder / name).mkdir()
        found[name] = npz.write(folder / name, arrays | npz.TRUTH)
    found["scannet"] = write_scannet(folder / "scannet")
    found["tum"] = write_tum(folder / "freiburg1")
    found["kitti"] = write_kitti(folder / "kitti" / "00")
    found["replicacad"] = write_replicacad(folder / "replicacad")
    for suffix in (".ply", ".pcd"):
        found[suffix] = write_clouds(folder / suffix[1:], range(4), suffix)
        write_poses(found[suffix] / "poses.txt", range(4))
    for kind in ("ros1", "sqlite3", "mcap"):
        found[kind] = write_bag(folder / f"bag_{kind}", kind)

    for kind in ("ply", "obj", "stl", "off", "glb"):
        (folder / f"mesh_{kind}").mkdir()
        found[f"mesh_{kind}"] = folder / f"mesh_{kind}" / f"box.{kind}"
        trimesh.creation.box((2, 2, 2)).export(found[f"mesh_{kind}"])

    def read_mesh(path):
        scene = scoring.read_scene(path, np.zeros((3, 3)))
        sdf, grad = scene.sdf_and_grad(np.linspace([-1, -1, -2], [1, 2, 1], 20))
        assert np.isfinite(sdf).all() and np.isfinite(grad).all()
        scene.cast(np.zeros((3, 3)), np.eye(3))

    def read_stream(path):
        options = {"intrinsics": (6.0, 5.0, 3.3, 2.1)} if path.name == "freiburg1" else {}
        kinds = {".npz": "npz", ".bag": "rosbag"}
        kind = kinds.get(path.suffix) or ("rosbag" if path.name.startswith("bag_") else path.name)
        kind = {"freiburg1": "tum", "00": "kitti", "ply": "clouds", "pcd": "clouds"}.get(kind, kind)
        stream = datasets.open_stream(path, kind, **options)
        if kind == "npz":
            datasets.read_truth(path)
        good = 0
        for i in range(min(len(stream), 10)):
            try:
                cloud, pose = datasets.read_frame(stream, i)
            except datasets.BadFrameError as error:
                assert not _ran_out(error), error
                continue
            good += 1
            assert cloud.dtype == pose.dtype == np.float32
            assert cloud.ndim == 2 and cloud.shape[1] == 3 and pose.shape == (4, 4)
        if good:
            try:
                extent = datasets.find_bounds(stream, skip_bad_frames=True)
            except ValueError as error:
                assert "none of" in str(error), error
            else:
                assert np.isfinite(extent.bounds).all() and np.isfinite(extent.max_range)

    def read_map(path):
        state = hio.load(path)
        leaves = jax.tree.leaves((state.grid, state.network, state.optimism))
        assert all(np.isfinite(np.asarray(leaf, np.float64)).all() for leaf in leaves)

    config = hio.Config.light(((0, 0, 0), (0.4, 0.3, 0.2)), hidden_width=4, hidden_layers=1)
    (folder / "map").mkdir()
    hio.save(folder / "map" / "map.npz", hio.init(config, jax.random.key(0)))
    found["map"] = folder / "map" / "map.npz"
    readers = {"map": read_map, "mesh": read_mesh}
    return {
        name: (path, readers.get(name.split("_")[0], read_stream)) for name, path in found.items()
    }


def _ran_out(error):
    """Whether an error, or one that it was made of, is of memory."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__
    return False


def read_case(read, path):
    """Returns "good" or "refused", or what is wrong with the reader."""
    try:
        read(path)
        return "good"
    except ValueError as error:
        if _ran_out(error) and "ROS bag" not in str(error):
            # rosbags asks a file for as many bytes as it declares; none of them is touched.
            return f"out of memory: {error}"
        text = str(error)
        named = str(path) in text or str(path.parent) in text
        return "refused" if named and "\n" not in text else f"message {text!r}"
    except OSError as error:
        return "refused" if error.filename is not None else f"{type(error).__name__}: {error}"
    except (Exception, Hang) as error:
        return f"{type(error).__name__}: {error}"


def main(first, count):
    os.environ["TQDM_DISABLE"] = "1"
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp())
    recordings = write_recordings(folder)
    for path, read in recordings.values():  # imports and compiles
        read(path)

    def stop(*_):
        raise Hang(f"more than {SECONDS} s")

    signal.signal(signal.SIGALRM, stop)
    signal.signal(signal.SIGPROF, stop)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + (_ADDRESSES_MB << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    summary = {"good": 0, "refused": 0, "faults": []}
    for case in range(first, first + count):
        print(case, file=sys.stderr, end="\r", flush=True)  # the last one, if the process dies
        rng = np.random.default_rng(case)
        name = list(recordings)[case % len(recordings)]
        path, read = recordings[name]
        files = sorted(each for each in path.rglob("*") if each.is_file()) or [path]
        file = files[int(rng.integers(len(files)))]
        data = file.read_bytes()
        mutate(file, rng, folder)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.alarm(WAITING_SECONDS)
        outcome = read_case(read, path)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        if outcome in summary:
            summary[outcome] += 1
        else:
            summary["faults"].append([case, name, file.name, outcome[:400]])
        if peak > before + MEMORY_MB:
            summary["faults"].append([case, name, file.name, f"{peak} MB after {before} MB"])
            before = peak
        restore(file, data)
    summary["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    shutil.rmtree(folder)
    print(json.dumps(summary))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
