"""A folder of point clouds with a trajectory.

- `*.ply` or `*.pcd`: m, sensor frame.
- a trajectory in TUM's format, `timestamp tx ty tz qx qy qz qw` on each line: T_world_sensor.

If the file names are times within the trajectory (seconds, or nanoseconds as whole numbers), each
cloud gets the pose interpolated at its time. Otherwise there must be as many poses as clouds, and
the poses belong to the clouds in the order of their names. If there are as many poses as clouds,
the times 0, 1, 2, ... are also numbers of clouds in this order. A file that begins with `# frame`,
as a run writes it, has numbers of clouds, from 0, and may lack some.

With as many poses as clouds, both readings may give poses, but not the same ones. If the times then
leave a cloud without a pose, the folder is refused. Without poses the file names are the times, if
they are numbers.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hiosdf_jax._src.datasets.files import most_returns, open_regular, parsing, read_lines
from hiosdf_jax._src.datasets.inflating import most_inflated
from hiosdf_jax._src.datasets.stream import FrameStream, NoPosesError
from hiosdf_jax._src.datasets.timed_poses import TimedPoses, pose_at, read_timed_poses, rows_at

_MAX_GAP = 0.2  # s
_PLY_HEADER_BYTES = 1 << 16
_PCD_LINES = 10  # of a header
_PCD_VALUES = 1000  # per point
_TIME = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)
_NANOSECONDS = 1e17  # times from here on are in nanoseconds


def cloud_stream(
    folder: str | os.PathLike[str],
    trajectory: str | os.PathLike[str] | None = None,
    *,
    poses: bool = True,
) -> FrameStream:
    """Opens a folder of PLY or PCD clouds with a trajectory.

    Args:
        folder: The folder with `*.ply` or `*.pcd`.
        trajectory: The file of poses; by default the only .txt or .tum file in the folder.
        poses: Whether to read a trajectory. If not, each pose is the identity.

    Returns:
        The clouds as a stream, in the order of their times or names. A cloud that cannot be read
        or has no pose at its time is a bad frame.

    Raises:
        FileNotFoundError: A file or folder is missing.
        NoPosesError: The folder has no .txt or .tum file, and none is given.
        ValueError: The trajectory is malformed, ambiguous, or does not fit the clouds.
        ModuleNotFoundError: There are .pcd files and pypcd4 is not installed.

    Example:
        stream = datasets.cloud_stream("scans", trajectory="poses.txt")
        cloud, pose = stream[0]
    """
    folder = Path(folder)
    clouds = _sorted([path for path in folder.iterdir() if path.suffix.lower() in _READERS])
    if not clouds:
        raise ValueError(f"{folder}: has no .ply or .pcd file, expected at least one")
    if any(path.suffix.lower() == ".pcd" for path in clouds):
        _require_pypcd4()
    if not poses:
        stamps = [_stamp(path) for path in clouds]
        return FrameStream(folder, len(clouds), lambda i: (_read(clouds[i]), np.eye(4)), stamps)
    trajectory = _only_trajectory(folder) if trajectory is None else trajectory
    timed = read_timed_poses(trajectory)
    stamps = np.arange(len(clouds)) if _numbers_frames(trajectory) else _stamps(clouds, timed)

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        return _read(clouds[index]), pose_at(timed, stamps[index], _MAX_GAP)

    return FrameStream(folder, len(clouds), frame, stamps)


def _read(path: Path) -> np.ndarray:
    return _READERS[path.suffix.lower()](path)


def _sorted(clouds: list[Path]) -> list[Path]:
    """Sorts clouds by the times that are their names, or else by the numbers in their names."""
    clouds = sorted(clouds, key=lambda path: (_natural(path), path.name))
    stamps = np.array([_stamp(path) for path in clouds])
    # Versions such as 1.1 and 1.10 are not times.
    if np.isfinite(stamps).all() and len(np.unique(stamps)) == len(stamps):
        return [clouds[i] for i in np.argsort(stamps)]
    return clouds


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in _parts(path.stem)]


def _parts(text: str) -> list[str]:
    return [part for part in re.split(r"(\d+)", text) if part]


def _only_trajectory(folder: Path) -> Path:
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".txt", ".tum"))
    if not found:
        raise NoPosesError(f"{folder}: has no poses, expected a trajectory in a .txt or .tum file")
    if len(found) != 1:
        names = [path.name for path in found]
        raise ValueError(f"{folder}: trajectory is one of {names}, expected one .txt or .tum file")
    return found[0]


def _numbers_frames(trajectory: str | os.PathLike[str]) -> bool:
    """Whether a run wrote the file, which has numbers of frames instead of times."""
    _, first = next(read_lines(trajectory))
    return first.split()[:2] == ["#", "frame"]


def _stamps(clouds: list[Path], poses: TimedPoses) -> np.ndarray:
    """Time stamp of each cloud, (N,) s."""
    stamps = np.array([_stamp(path) for path in clouds])
    inside = (stamps >= poses.stamps[0]) & (stamps <= poses.stamps[-1])  # NaN is outside
    are_times = inside.mean() > 0.5  # the trajectory may start late or end early
    if len(clouds) == len(poses.stamps):
        if not are_times or np.array_equal(poses.stamps, np.arange(len(clouds))):
            return poses.stamps
        _check_order(clouds, stamps, poses)
    if are_times:
        return stamps
    raise ValueError(
        f"{poses.source}: {len(poses.stamps)} poses from {poses.stamps[0]:.6f} to "
        f"{poses.stamps[-1]:.6f} s for the {len(clouds)} clouds {clouds[0].name} to "
        f"{clouds[-1].name}, expected names that are times in between, or as many poses as clouds"
    )


def _check_order(clouds: list[Path], stamps: np.ndarray, poses: TimedPoses) -> None:
    """Raises if the times of as many poses as clouds disagree with their order.

    They do if one cloud has no pose at its time, and another not the pose of its rank.
    """
    rows = [rows_at(poses, stamp, _MAX_GAP) for stamp in stamps]
    lost = next((path for path, found in zip(clouds, rows, strict=True) if not found), None)
    if lost and any(found and rank not in found for rank, found in enumerate(rows)):
        raise ValueError(
            f"{poses.source}: {len(stamps)} poses for as many clouds, but none at the time of "
            f"{lost.name}; expected one at the time of each cloud, or the times 0, 1, 2, ... for "
            "poses in the order of the clouds"
        )


def _stamp(path: Path) -> float:
    if not re.fullmatch(_TIME, path.stem):  # float also takes 1_000, 1e5 and nan
        return float("nan")
    value = float(path.stem)
    return 1e-9 * value if value >= _NANOSECONDS else value


def _read_ply(path: Path) -> np.ndarray:
    import trimesh

    with open_regular(path) as file, parsing(path, "PLY file"):
        counts = ply_counts(file)
        # Without the path, trimesh does not open other files that this one names.
        vertices = getattr(trimesh.load(file, "ply", process=False), "vertices", None)
        cloud = np.zeros((0, 3)) if vertices is None else np.asarray(vertices)
        # trimesh reads an ASCII file that is cut off after a line as a smaller cloud.
        _check_count(cloud, counts.get("vertex", len(cloud)))
    return cloud


def ply_counts(file: BinaryIO) -> dict[str, int]:
    """Reads how many of its elements a PLY file declares.

    Args:
        file: The file; it is read from its beginning, and left there.

    Returns:
        The counts by name, such as "vertex" and "face".

    Raises:
        ValueError: It has no such header, or declares more than fit into it.
    """
    file.seek(0)
    header, end, _ = file.read(_PLY_HEADER_BYTES).partition(b"end_header")
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if not end:
        raise ValueError(f"it has no end of a header in its first {_PLY_HEADER_BYTES} bytes")
    counts = {}
    for words in map(str.split, header.decode("ascii", "replace").split("\n")):
        if words and "element" in words[0]:
            _, name, count = words
            counts[name] = int(count)
            if not 0 <= counts[name] <= size:  # each takes a byte at least
                raise ValueError(f"it declares {count} of {name} in {size} bytes")
    return counts


def _read_pcd(path: Path) -> np.ndarray:
    from pypcd4 import PointCloud  # pyright: ignore[reportPrivateImportUsage]

    with open_regular(path) as file, parsing(path, "PCD file"):
        _check_declared(file)
        file.seek(0)
        content = PointCloud.from_fileobj(file)
        cloud = content.numpy(("x", "y", "z")).reshape(-1, 3)  # a single point comes as a row
        _check_count(cloud, content.metadata.points)
    return cloud


def _check_declared(file: BufferedReader) -> None:
    """Compares what a PCD file declares with its size, before memory is taken for it."""
    from pypcd4 import Encoding, MetaData  # pyright: ignore[reportPrivateImportUsage]

    lines: list[str] = []
    while len(lines) < _PCD_LINES and not (lines and lines[-1].startswith("DATA")):
        text = file.readline(65536).decode("utf-8")
        if not text:
            break
        if text.strip() and not text.startswith("#"):
            lines.append(text.strip())
    header = MetaData.parse_header(lines)
    start = file.tell()
    rest = file.seek(0, os.SEEK_END) - start
    values = sum(header.count)
    size = header.points * sum(a * b for a, b in zip(header.size, header.count, strict=True))
    least = size
    if header.data == Encoding.ASCII:
        least = 2 * header.points * values - 1  # a digit and a space
    elif header.data != Encoding.BINARY and header.points:
        file.seek(start)
        least, inflated = struct.unpack("<II", file.read(8))
        if inflated != size:
            raise ValueError(f"it inflates to {inflated} bytes, expected {size}")
        if inflated > most_inflated(rest):
            raise ValueError(
                f"it inflates to {inflated} bytes, expected at most {most_inflated(rest)}"
            )
    most = most_returns(rest)
    if header.points > most or values > _PCD_VALUES:
        raise ValueError(
            f"it declares {header.points} points of {values} values, expected at most "
            f"{most} of {_PCD_VALUES}"
        )
    if least > rest:
        raise ValueError(f"it has {rest} bytes of data, expected {least}; is it cut off?")


def _check_count(cloud: np.ndarray, expected: int) -> None:
    if len(cloud) != expected:
        raise ValueError(f"has {len(cloud)} points, expected {expected}")


def _require_pypcd4() -> None:
    try:
        import pypcd4  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            ".pcd files are read by pypcd4: in a clone, pip install '.[pcd]'"
        ) from error


_READERS: dict[str, Callable[[Path], np.ndarray]] = {".ply": _read_ply, ".pcd": _read_pcd}
