"""The `hiosdf` command: `hiosdf demo`, `hiosdf map STREAM`."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Nothing heavy is imported up here: `hiosdf --help` answers at once.
if TYPE_CHECKING:
    import numpy as np

    from hiosdf_jax._src.config import Config
    from hiosdf_jax._src.scoring.metrics import GroundTruth
    from hiosdf_jax.datasets import Stream

_NOTHING_MAPPED, _NOT_REACHED, _BAD_INPUT = 1, 1, 2  # exit codes; argparse itself exits with 2
_OUTPUT = Path("hiosdf_output")
_DEMO_FRAMES = 80
_SKIP_HINT = " (--skip-bad-frames goes on without such frames)"


class _Failure(Exception):
    """What ends the command with a line on stderr and an exit code."""

    def __init__(self, message: object, code: int) -> None:
        super().__init__(message)
        self.code = code


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: Those after the command's name; by default those of the process.

    Returns:
        The exit code: 0, 1 if no frame could be mapped or the robot did not come to its goal, 2 if
        a file, a frame or a value is not what it should be.

    Raises:
        SystemExit: An argument is unknown or malformed, or help was asked for.
    """
    options = _parser().parse_args(arguments)
    try:
        options.command(options)
    except _Failure as failure:
        print(f"hiosdf: {failure}", file=sys.stderr)
        return failure.code
    return 0


def _demo(options: argparse.Namespace) -> None:
    from hiosdf_jax import demo

    if options.plan:
        _plan(options)
        return
    frames = options.frames or _DEMO_FRAMES
    stream = demo.ApartmentStream(frames=frames, seed=options.seed)
    config = _configure(options.config, demo.BOUNDS_WORLD, max_range=stream.max_range)
    print(f"{len(stream)} frames of a depth camera carried through a furnished apartment")
    _run(
        stream,
        config,
        options.output or _OUTPUT / "demo",
        name="demo",
        seed=options.seed,
        truth=demo.sample_truth(stream),
        exact_sdf=lambda points_world: demo.signed_distance(stream.model, points_world)[0],
    )


def _plan(options: argparse.Namespace) -> None:
    for name in ("frames", "config"):
        if getattr(options, name) is not None:
            raise _Failure(f"--{name} is not of --plan, which has its own", _BAD_INPUT)
    try:
        from hiosdf_jax._src.demo import exploration, picture
    except ModuleNotFoundError as error:
        if error.name != "jax_mppi":
            raise
        hint = "--plan needs jax-mppi: pip install 'hiosdf_jax[plan]'"
        raise _Failure(hint, _BAD_INPUT) from error

    output = options.output or _OUTPUT / "demo_plan"
    try:
        output.mkdir(parents=True, exist_ok=True)
        print("a robot looks for its way through an apartment that it does not know")
        run = exploration.explore(options.seed)
        print("drawing plan.png and plan.gif")
        picture.write_run(output, run)
    except OSError as error:
        raise _Failure(_told(error), _BAD_INPUT) from error
    told = run.metrics
    print(
        f"from the {told['from']} to the {told['to']}: {told['path_m']:.1f} m in "
        f"{told['robot_s']:.0f} s, {told['updates']} updates of the map, "
        f"least clearance {100 * told['least_clearance_m']:.1f} cm"
    )
    print(f"wrote {output}{os.sep} (the run took {told['wall_s']:.0f} s)")
    if told["collided"]:
        raise _Failure("the robot collided", _NOT_REACHED)
    if not told["reached"]:
        raise _Failure("the robot did not come to its goal", _NOT_REACHED)


def _map(options: argparse.Namespace) -> None:
    from hiosdf_jax import datasets

    if options.save is not None and not options.save.parent.is_dir():
        raise _Failure(f"{options.save.parent}: no such folder", _BAD_INPUT)
    if options.ground_truth is not None and not options.ground_truth.exists():
        raise _Failure(f"{options.ground_truth}: No such file or folder", _BAD_INPUT)
    bounds, max_range = options.bounds, options.max_range
    if bounds is not None:
        bounds = (tuple(bounds[:3]), tuple(bounds[3:]))
    overrides = {"max_range": max_range, "voxel_size": options.voxel_size}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    # Before minutes are spent on reading; on some box, if it is still to be found.
    _configure(options.config, bounds or ((0, 0, 0), (10, 10, 10)), **overrides)
    names = ("intrinsics", "trajectory", "cloud_topic", "odometry_topic", "world_frame")
    chosen = {name: getattr(options, name) for name in names}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    stream = _checked(lambda: datasets.open_stream(options.stream, options.format, **chosen))
    truth = None
    if isinstance(stream, datasets.NpzStream) and options.ground_truth is None:
        truth = _checked(lambda: datasets.ground_truth(options.stream))
    if options.frames is not None:
        count = min(options.frames, len(stream))
        stream = datasets.FrameStream(options.stream, count, stream.__getitem__)
    if bounds is None or max_range is None:
        extent = _checked(
            lambda: datasets.find_bounds(stream, skip_bad_frames=options.skip_bad_frames),
            code=_NOTHING_MAPPED,
        )
        bounds = bounds or extent.bounds
        max_range = max_range or math.ceil(10 * extent.max_range) / 10
        (x0, y0, z0), (x1, y1, z1) = bounds
        print(
            f"bounds x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}, z {z0:.1f} to {z1:.1f} m; "
            f"returns up to {max_range:.1f} m"
        )
    exact_sdf = None
    if options.ground_truth is not None:
        truth, exact_sdf = _ground_truth(options.ground_truth, stream, max_range)
    overrides["max_range"] = max_range
    place = options.stream.absolute()
    _run(
        stream,
        _configure(options.config, bounds, **overrides),
        options.output or _OUTPUT / (place.name if place.is_dir() else place.stem),
        name=place.name,
        seed=options.seed,
        truth=truth,
        exact_sdf=exact_sdf,
        save_path=options.save,
        skip_bad_frames=options.skip_bad_frames,
    )


def _ground_truth(
    file: Path, stream: Stream, max_range: float
) -> tuple[GroundTruth, Callable[[np.ndarray], np.ndarray]]:
    """Exact distances where the stream has seen, and to draw."""
    from hiosdf_jax._src.scoring import visible

    rays = _checked(lambda: visible.read_rays(stream, max_range), code=_NOTHING_MAPPED)
    scene = _checked(lambda: visible.read_scene(file, visible.sensor_path(rays)))
    truth = _checked(lambda: visible.sample_visible(scene, rays))
    return truth, scene.sdf_to_draw


def _configure(name: str | None, bounds: Any, **overrides: float) -> Config:
    from hiosdf_jax._src.config import Config

    return _checked(lambda: getattr(Config, name or "light")(bounds, **overrides))


def _run(stream: Stream, config: Config, output: Path, **settings: Any) -> None:
    from hiosdf_jax import datasets
    from hiosdf_jax._src.command import run

    try:
        run.run_stream(stream, config, output, **settings)
    except datasets.BadFrameError as error:
        raise _Failure(f"{error}{_SKIP_HINT}", _BAD_INPUT) from error
    except run.NothingMappedError as error:
        raise _Failure(error, _NOTHING_MAPPED) from error
    except OSError as error:
        raise _Failure(_told(error), _BAD_INPUT) from error


def _checked[Result](call: Callable[[], Result], code: int = _BAD_INPUT) -> Result:
    """Calls, and makes one line of what is wrong with the input."""
    from hiosdf_jax import datasets

    try:
        return call()
    except datasets.BadFrameError as error:
        raise _Failure(f"{error}{_SKIP_HINT}", _BAD_INPUT) from error
    except (OSError, ValueError, ModuleNotFoundError) as error:
        raise _Failure(_told(error), code) from error


def _told(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fspath(error.filename)}: {error.strerror}"
    return " ".join(str(error).split())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hiosdf", description="Signed distance fields from posed point clouds, online."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--config",
        choices=("light", "paper", "default"),
        help="light, the one you get without this, is sized for a CPU, default for a GPU, paper "
        "has the paper's numbers",
    )
    common.add_argument(
        "--seed", type=_whole(0), default=0, help="of all randomness (default: %(default)s)"
    )

    demo = commands.add_parser(
        "demo",
        parents=[common],
        help="map a simulated apartment and score the map",
        description="Maps a simulated, furnished apartment, scores the map against exact "
        "distances, and draws it; or, with --plan, lets a robot explore it.",
    )
    demo.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for metrics and pictures (default: hiosdf_output/demo, or demo_plan)",
    )
    demo.add_argument(
        "--frames",
        type=_whole(1),
        metavar="N",
        help=f"frames along the camera's path (default: {_DEMO_FRAMES})",
    )
    demo.add_argument(
        "--plan",
        action="store_true",
        help="instead, let a robot find its way to another room on nothing but its own map; needs "
        "jax-mppi. --seed chooses start and goal as well",
    )
    demo.set_defaults(command=_demo)

    map_ = commands.add_parser(
        "map",
        parents=[common],
        help="map a recorded stream",
        description="Maps a recorded stream, scores the map and draws it. Without exact distances "
        "(eval_* of an .npz file, or --ground-truth) it is scored on frames that the map is not "
        "given. A frame that cannot be used ends the mapping with exit code 2; what came before it "
        "is written all the same.",
    )
    map_.add_argument(
        "stream",
        type=Path,
        metavar="STREAM",
        help="file or folder; hiosdf_jax/datasets/ has a description of each format",
    )
    map_.add_argument(
        "--format",
        metavar="NAME",
        help="npz, replicacad, scannet, tum, kitti, clouds or rosbag (default: what the file or "
        "folder looks like)",
    )
    map_.add_argument(
        "--skip-bad-frames",
        action="store_true",
        help="pass over frames that cannot be read or have no usable pose, and count them",
    )
    map_.add_argument(
        "--intrinsics",
        type=float,
        nargs=4,
        metavar=("FX", "FY", "CX", "CY"),
        help="of tum: pixels (default: by freiburg1, 2 or 3 in the folder's name)",
    )
    map_.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="of clouds: the poses (default: the one .txt or .tum file in the folder)",
    )
    map_.add_argument("--cloud-topic", metavar="TOPIC", help="of rosbag, if it has several")
    map_.add_argument(
        "--odometry-topic", metavar="TOPIC", help="of rosbag, if tf does not say how it moves"
    )
    map_.add_argument(
        "--world-frame", metavar="FRAME", help="of rosbag (default: the root of tf's tree)"
    )
    map_.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for metrics and pictures (default: hiosdf_output/STREAM)",
    )
    map_.add_argument(
        "--bounds",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="the mapped box, m, world (default: found in a first pass over the stream)",
    )
    map_.add_argument("--voxel-size", type=float, metavar="M", help="of the coarse grid")
    map_.add_argument(
        "--max-range",
        type=float,
        metavar="M",
        help="farther returns leave no surface (default: found in the first pass)",
    )
    map_.add_argument("--frames", type=_whole(1), metavar="N", help="only the first N frames")
    map_.add_argument(
        "--ground-truth",
        type=Path,
        metavar="FILE",
        help="score against the scene itself: a triangle mesh in the stream's world frame and in "
        "metres, or a folder with sdf.npy and transform.txt as of iSDF",
    )
    map_.add_argument("--save", type=Path, metavar="FILE", help="write the map, for hio.load")
    map_.set_defaults(command=_map)
    return parser


def _whole(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value}, expected at least {least}")
        return value

    return whole_number
