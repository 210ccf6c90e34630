"""The arguments of the `hiosdf` command and its help texts."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

from hiosdf_jax._src.command import examples

DEMO_FRAMES = 80
"""Frames of `hiosdf demo` if --frames is not given."""

_HELP_STYLE = argparse.RawDescriptionHelpFormatter  # keeps the line breaks of the examples
_Subcommands = argparse._SubParsersAction  # argparse has no public name for it


def parser_of(
    commands: Mapping[str, Callable[[argparse.Namespace], None]],
) -> argparse.ArgumentParser:
    """Makes the parser of the command's arguments.

    Args:
        commands: The function of each subcommand, by its name. `options.command` is that of the
            chosen one.

    Returns:
        The parser.
    """
    parser = argparse.ArgumentParser(
        prog="hiosdf",
        description="Signed distance fields from posed point clouds, online.",
        epilog=examples.HIOSDF,
        formatter_class=_HELP_STYLE,
    )
    subcommands = parser.add_subparsers(required=True, metavar="COMMAND")
    configured, viewed = _configuration(), _viewer()
    mapping = _mapping(configured)
    parsers = {
        "demo": _add_demo(subcommands, [mapping, viewed]),
        "map": _add_map(subcommands, [mapping, viewed]),
        "view": _add_view(subcommands, [viewed]),
        "export": _add_export(subcommands),
        "eval": _add_eval(subcommands),
        "info": _add_info(subcommands),
        "bench": _add_bench(subcommands, [configured]),
    }
    for name, subcommand in parsers.items():
        subcommand.set_defaults(command=commands[name])
    return parser


def _configuration() -> argparse.ArgumentParser:
    """The option of all commands that make maps."""
    sized = argparse.ArgumentParser(add_help=False)
    sized.add_argument(
        "--config",
        choices=("light", "paper", "default"),
        help="size of the map: light suits a CPU, default a GPU, paper has the paper's numbers "
        "(default: light on a CPU, default on a GPU)",
    )
    return sized


def _mapping(sized: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The options of `demo` and `map`."""
    common = argparse.ArgumentParser(add_help=False, parents=[sized])
    common.add_argument("--seed", type=_whole(0), help="seed of all randomness (default: 0)")
    common.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help='write the map, for hio.load("FILE") and --resume FILE',
    )
    common.add_argument(
        "--checkpoint-every",
        type=_whole(1),
        metavar="N",
        help="write the map after every N updates, too: to --save, or to checkpoint.npz in the "
        "folder of the output",
    )
    common.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="continue the map that a run of the same stream has written; its configuration, "
        "bounds and seed are used",
    )
    common.add_argument(
        "--view",
        action="store_true",
        help="show the map in a browser while it grows, until Ctrl-C; needs viser",
    )
    return common


def _viewer() -> argparse.ArgumentParser:
    """The options of the view in a browser."""
    served = argparse.ArgumentParser(add_help=False)
    served.add_argument(
        "--export",
        type=Path,
        metavar="FILE",
        help="write the view as one HTML file that needs no server; needs viser",
    )
    served.add_argument(
        "--host",
        default="127.0.0.1",
        help="address of the view (default: 127.0.0.1, which only this machine can reach)",
    )
    served.add_argument(
        "--port",
        type=_whole(0),
        default=8080,
        help="port of the view; the next free one is taken (default: 8080)",
    )
    return served


def _add_demo(
    subcommands: _Subcommands, parents: list[argparse.ArgumentParser]
) -> argparse.ArgumentParser:
    demo = subcommands.add_parser(
        "demo",
        parents=parents,
        help="map a simulated apartment and score the map",
        description="Map a simulated, furnished apartment, score the map against exact distances\n"
        "and draw it. Or, with --plan, let a robot explore it.",
        epilog=examples.DEMO,
        formatter_class=_HELP_STYLE,
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
        help=f"number of frames along the camera's path (default: {DEMO_FRAMES})",
    )
    demo.add_argument(
        "--plan",
        action="store_true",
        help="let a robot drive to another room, knowing only its own map; --seed also chooses "
        "start and goal; needs the extra [plan]",
    )
    return demo


def _add_map(
    subcommands: _Subcommands, parents: list[argparse.ArgumentParser]
) -> argparse.ArgumentParser:
    map_ = subcommands.add_parser(
        "map",
        parents=parents,
        help="map a recorded stream and score the map",
        description="Map a recorded stream of posed clouds, score the map and draw it.",
        epilog=examples.MAP,
        formatter_class=_HELP_STYLE,
    )
    map_.add_argument("stream", type=Path, metavar="STREAM", help="file or folder; see --format")
    map_.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for metrics and pictures (default: hiosdf_output/STREAM)",
    )
    map_.add_argument("--frames", type=_whole(1), metavar="N", help="use only the first N frames")
    map_.add_argument(
        "--skip-bad-frames",
        action="store_true",
        help="skip and count frames that cannot be read, have no return or no usable pose",
    )
    map_.add_argument(
        "--ground-truth",
        type=Path,
        metavar="FILE",
        help="score against the scene: a triangle mesh (.ply, .obj, .stl, .off or .glb) in the "
        "stream's world frame and in meters, "
        "or a folder with iSDF's sdf.npy and transform.txt",
    )
    _add_pose_options(map_)
    _add_size_options(map_)
    _add_format_options(map_)
    return map_


def _add_pose_options(map_: argparse.ArgumentParser) -> None:
    poses = map_.add_mutually_exclusive_group()
    poses.add_argument(
        "--refine-poses",
        action="store_true",
        help="for poses that drift: refine each one against the map before its frame is fused; "
        "exact poses become worse",
    )
    poses.add_argument(
        "--odometry",
        action="store_true",
        help="use only the first pose of the stream, if it has poses, and register the other "
        "frames to the map; between frames the motion may change by about 10 cm and 5 degrees",
    )
    map_.add_argument(
        "--drift",
        type=float,
        nargs=2,
        metavar=("SHARE", "DEG"),
        help="with --refine-poses: standard deviations of the motion between poses, as a share of "
        "the distance traveled and in degrees per meter, such as 0.01 0.2",
    )


def _add_size_options(map_: argparse.ArgumentParser) -> None:
    size = map_.add_argument_group("size of the map")
    size.add_argument(
        "--bounds",
        type=float,
        nargs=6,
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="mapped box, m, world frame (default: found in a first reading of the stream; with "
        "--odometry 3 m around what the sensor sees from its first position)",
    )
    size.add_argument(
        "--voxel-size", type=float, metavar="M", help="edge of a voxel, m (default: 0.1)"
    )
    size.add_argument(
        "--max-range",
        type=float,
        metavar="M",
        help="returns beyond this range, m, leave no surface (default: found in a first reading)",
    )


def _add_format_options(map_: argparse.ArgumentParser) -> None:
    formats = map_.add_argument_group("format of the stream")
    formats.add_argument(
        "--format",
        metavar="NAME",
        help="npz, replicacad, scannet, tum, kitti, clouds or rosbag (default: recognized from the "
        "file or folder)",
    )
    formats.add_argument(
        "--intrinsics",
        type=float,
        nargs=4,
        metavar=("FX", "FY", "CX", "CY"),
        help="tum: intrinsics in pixels (default: from freiburg1, 2 or 3 in the folder's name)",
    )
    formats.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="clouds: file of poses (default: the only .txt or .tum file in the folder)",
    )
    formats.add_argument(
        "--cloud-topic", metavar="TOPIC", help="rosbag: topic of the clouds, if there are several"
    )
    formats.add_argument(
        "--odometry-topic",
        metavar="TOPIC",
        help="rosbag: topic of the odometry, if tf does not contain the motion",
    )
    formats.add_argument(
        "--world-frame",
        metavar="FRAME",
        help="rosbag: frame of the map (default: the root of the tf tree)",
    )


def _add_view(
    subcommands: _Subcommands, parents: list[argparse.ArgumentParser]
) -> argparse.ArgumentParser:
    view = subcommands.add_parser(
        "view",
        parents=parents,
        help="show a saved map in a browser",
        description="Show a saved map in a browser, in three dimensions.",
        epilog=examples.VIEW,
        formatter_class=_HELP_STYLE,
    )
    view.add_argument("map", type=Path, metavar="MAP", help="a saved map")
    return view


def _add_export(subcommands: _Subcommands) -> argparse.ArgumentParser:
    export = subcommands.add_parser(
        "export",
        help="write a saved map as a file of another program",
        description="Write a saved map as a file of another program, by the suffix of its name.",
        epilog=examples.EXPORT,
        formatter_class=_HELP_STYLE,
    )
    export.add_argument(
        "map", type=Path, metavar="MAP", help="a saved map; for .csv, a metrics.json"
    )
    export.add_argument("--to", type=Path, required=True, metavar="FILE", help="the file to write")
    export.add_argument(
        "--resolution",
        type=float,
        default=0.05,
        metavar="M",
        help="spacing of the samples, edge of a cell or of a triangle, m (default: 0.05)",
    )
    robot = export.add_argument_group("costmap")
    for name, text in {
        "floor": "height of the floor, m, world frame",
        "height": "height of the robot, m",
        "radius": "radius of the robot, m",
        "step": "obstacles up to this height above the floor are ignored, m (default: 0.1)",
    }.items():
        robot.add_argument(f"--{name}", type=float, metavar="M", help=text)
    return export


def _add_eval(subcommands: _Subcommands) -> argparse.ArgumentParser:
    eval_ = subcommands.add_parser(
        "eval",
        help="score a saved map against exact distances",
        description="Score a saved map against exact distances, where its stream has observed the\n"
        "scene: those of an .npz stream (eval_*), or a mesh.",
        epilog=examples.EVAL,
        formatter_class=_HELP_STYLE,
    )
    eval_.add_argument("map", type=Path, metavar="MAP", help="a saved map")
    eval_.add_argument("stream", type=Path, metavar="STREAM", help="the stream that was mapped")
    eval_.add_argument(
        "--ground-truth",
        type=Path,
        metavar="FILE",
        help="score against the scene: a triangle mesh in the stream's world frame and in meters, "
        "or a folder with iSDF's sdf.npy and transform.txt",
    )
    eval_.add_argument("--to", type=Path, metavar="FILE", help="write the scores as JSON, too")
    eval_.set_defaults(format=None, frames=None)
    return eval_


def _add_info(subcommands: _Subcommands) -> argparse.ArgumentParser:
    info = subcommands.add_parser(
        "info",
        help="describe a saved map",
        description="Describe a saved map: its extent, updates, memory, problems, configuration.",
    )
    info.add_argument("map", type=Path, metavar="MAP", help="a saved map")
    return info


def _add_bench(
    subcommands: _Subcommands, parents: list[argparse.ArgumentParser]
) -> argparse.ArgumentParser:
    bench = subcommands.add_parser(
        "bench",
        parents=parents,
        help="measure the speed on this machine",
        description="Measure updates and queries of a map of the demo's apartment. It takes about\n"
        "a minute on two CPU cores.",
        epilog=examples.BENCH,
        formatter_class=_HELP_STYLE,
    )
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON, too")
    return bench


def _whole(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value}, expected at least {least}")
        return value

    return whole_number
