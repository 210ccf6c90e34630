"""The `hiosdf` command: `hiosdf demo | map | eval | view | export | info | bench`."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hiosdf_jax._src.command.arguments import DEMO_FRAMES, parser_of
from hiosdf_jax._src.command.console import begin, check_console, lasting
from hiosdf_jax._src.command.failures import (
    BAD_INPUT,
    Failure,
    checked,
    message_of,
)
from hiosdf_jax._src.command.inputs import (
    complete,
    configure,
    open_inputs,
    option_name,
    resumed_map,
    seed_of,
    stamps_of,
    truth_of_scene,
)
from hiosdf_jax._src.command.outputs import check_folder, check_outputs, is_map
from hiosdf_jax._src.command.run import run_mapping
from hiosdf_jax._src.command.stopping import Stopping
from hiosdf_jax._src.command.watching import wait_for_signal
from hiosdf_jax._src.output_files import check_output, replacing_together

# Heavy imports are inside the functions, so that `hiosdf --help` responds at once.
if TYPE_CHECKING:
    from hiosdf_jax._src.command.stream_poses import Tracker
    from hiosdf_jax._src.datasets.stream import Stream

_NOT_REACHED = 1  # exit code
_OUTPUT = Path("hiosdf_output")
_MOST_DEMO_FRAMES = 100_000
_MOST_PORT = 65535
_MOST_SEED = 2**32 - 1  # JAX drops higher bits
_PLAN_RESULTS = ("plan.png", "plan.gif", "metrics.json")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: The arguments after the command's name; by default those of the process.

    Returns:
        The exit code: 0, 1 if no frame could be mapped or the robot did not reach its goal, 2 if a
        file, a frame or a value is not as expected, 128 plus its number if a signal ended the run.

    Raises:
        SystemExit: An argument is unknown or malformed, or help was requested.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parser_of(COMMANDS).parse_args(arguments)
    options.arguments = arguments
    # The one place where a command fails.
    with lasting() as out, Stopping() as stopping:
        options.stopping = stopping
        try:
            check_console(out)
            _check_numbers(options)
            options.command(options)
            check_console(out)
        except Failure as failure:
            print(f"hiosdf: {failure}", file=sys.stderr)
            return failure.code
        except (OSError, MemoryError) as error:
            print(f"hiosdf: {message_of(error) or 'out of memory'}", file=sys.stderr)
            return BAD_INPUT
        except RuntimeError as error:  # what JAX raises, whose import takes a second
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            print("hiosdf: out of memory; a smaller map takes less", file=sys.stderr)
            return BAD_INPUT
        except KeyboardInterrupt:
            print("hiosdf: stopped; nothing was written", file=sys.stderr)
            return 128 + (stopping.received or signal.SIGINT)
    return 0 if stopping.received is None else 128 + stopping.received


def _check_numbers(options: argparse.Namespace) -> None:
    """Raises a failure for numbers too large to count with."""
    most = {"seed": _MOST_SEED, "port": _MOST_PORT}
    if options.command is _demo:
        most["frames"] = _MOST_DEMO_FRAMES
    for name, limit in most.items():
        value = getattr(options, name, None)
        if value is not None and value > limit:
            raise Failure(f"--{name} is {value}, expected at most {limit}", BAD_INPUT)


def _demo(options: argparse.Namespace) -> None:
    if options.plan:
        _plan(options)
        return
    output = options.output or _OUTPUT / "demo"
    check_outputs(options, output)
    resumed = resumed_map(options)
    from hiosdf_jax._src.demo import apartment
    from hiosdf_jax._src.demo.primitives import signed_distance

    frames = options.frames or DEMO_FRAMES
    seed = seed_of(options, resumed)
    stream = apartment.ApartmentStream(frames=frames, seed=seed)
    if resumed is None:
        config = configure(options.config, apartment.BOUNDS_WORLD, max_range=stream.max_range)
    else:
        config = resumed.state.config
    begin(f"{len(stream)} frames of a depth camera carried through a furnished apartment")
    run_mapping(
        options,
        stream,
        config,
        output,
        name="demo",
        seed=seed,
        truth=apartment.sample_truth(stream),
        exact_sdf=lambda points_world: signed_distance(stream.model, points_world)[0],
        resumed=resumed,
        draw_growing=True,
    )


def _plan(options: argparse.Namespace) -> None:
    for name in ("frames", "config", "save", "checkpoint_every", "resume", "view", "export"):
        if getattr(options, name):
            raise Failure(f"{option_name(name)} cannot be combined with --plan", BAD_INPUT)
    output = options.output or _OUTPUT / "demo_plan"
    check_folder(options, output, _PLAN_RESULTS)
    try:
        importlib.import_module("skimage.graph")  # the search for paths needs it later
        from hiosdf_jax._src.demo import exploration, picture
    except ModuleNotFoundError as error:
        packages = {"jax_mppi": "jax-mppi", "skimage": "scikit-image"}
        package = packages.get((error.name or "").partition(".")[0])
        if package is None:
            raise
        hint = f"--plan needs {package}: in a clone, pip install '.[plan]'"
        raise Failure(hint, BAD_INPUT) from error

    begin("a robot explores an apartment that it does not know")
    run = exploration.explore(options.seed or 0)
    print("drawing plan.png and plan.gif")
    with replacing_together(output, _PLAN_RESULTS) as folder:
        picture.write_run(folder, run)
    metrics = run.metrics
    print(
        f"from the {metrics['from']} to the {metrics['to']}: {metrics['path_m']:.1f} m in "
        f"{metrics['robot_s']:.0f} s, {metrics['updates']} updates of the map, "
        f"least clearance {100 * metrics['least_clearance_m']:.1f} cm"
    )
    print(f"wrote {output}{os.sep} (the run took {metrics['wall_s']:.0f} s)")
    if metrics["collided"]:
        raise Failure("the robot collided", _NOT_REACHED)
    if not metrics["reached"]:
        raise Failure("the robot did not reach its goal", _NOT_REACHED)


def _map(options: argparse.Namespace) -> None:
    place = options.stream.absolute()
    tracking = "--odometry" if options.odometry else "--refine-poses"
    if options.resume is not None and (options.odometry or options.refine_poses):
        raise Failure(f"--resume cannot be combined with {tracking}: maps have no poses", BAD_INPUT)
    if options.drift is not None and not options.refine_poses:
        raise Failure("--drift needs --refine-poses", BAD_INPUT)
    if options.drift is not None:
        share, degrees_per_meter = options.drift
        if not (1e-4 <= share <= 1 and 1e-3 <= degrees_per_meter <= 90):
            raise Failure(
                f"--drift is {options.drift}, expected a share of 0.0001 to 1 and 0.001 to 90 "
                "degrees per meter",
                BAD_INPUT,
            )
    output = options.output or _OUTPUT / (place.name if place.is_dir() else place.stem)
    check_outputs(options, output)
    if options.ground_truth is not None and not options.ground_truth.exists():
        raise Failure(f"{options.ground_truth}: No such file or folder", BAD_INPUT)
    overrides = {"max_range": options.max_range, "voxel_size": options.voxel_size}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    bounds = None
    if options.bounds is not None:
        bounds = (tuple(options.bounds[:3]), tuple(options.bounds[3:]))
    # Checked before minutes are spent on reading; the bounds may still be unknown.
    configure(options.config, bounds or ((0, 0, 0), (10, 10, 10)), **overrides)
    resumed = resumed_map(options)
    stream, truth = open_inputs(options)
    begin(f"{place.name}: {len(stream)} frames")
    if resumed is not None:
        config = resumed.state.config
    else:
        if bounds is None or options.max_range is None:
            bounds, overrides["max_range"] = complete(bounds, options, stream)
        config = configure(options.config, bounds, **overrides)
    exact_sdf = None
    if options.ground_truth is not None:
        truth, exact_sdf = truth_of_scene(options.ground_truth, stream, config.max_range)
    run_mapping(
        options,
        stream,
        config,
        output,
        name=place.name,
        seed=seed_of(options, resumed),
        truth=truth,
        exact_sdf=exact_sdf,
        skip_bad_frames=options.skip_bad_frames,
        resumed=resumed,
        tracker=_tracker(options, stream),
    )


def _tracker(options: argparse.Namespace, stream: Stream) -> Tracker | None:
    if not (options.odometry or options.refine_poses):
        return None
    from hiosdf_jax._src.command.stream_poses import Tracker

    return Tracker(options.odometry, options.drift, stamps_of(stream))


def _view(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.mapping.lifecycle import snapshot
    from hiosdf_jax._src.view.live import Viewer

    if options.export is not None:
        checked(lambda: check_output(options.export))
    state = checked(lambda: load(options.map))
    port = 0 if options.export is not None else options.port
    viewer = checked(lambda: Viewer(host=options.host, port=port))
    viewer.show(snapshot(state))
    if options.export is not None:
        checked(lambda: viewer.export(options.export))
        print(f"wrote {options.export}")
    else:
        wait_for_signal(options.stopping, viewer.url)
    viewer.close()


def _export(options: argparse.Namespace) -> None:
    checked(lambda: check_output(options.to))
    if options.to.is_file() and is_map(options.to):
        raise Failure(f"--to {options.to} would replace a map", BAD_INPUT)
    if options.to.suffix == ".csv":
        _export_metrics(options.map, options.to)
    else:
        _export_map(options)
    print(f"wrote {options.to}")


def _export_map(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.view.exports.by_suffix import COSTMAPS, check_suffix, export_map

    suffix = checked(lambda: check_suffix(options.to))
    names = ("floor", "height", "radius", "step")
    robot = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if suffix in COSTMAPS and not {"floor", "height", "radius"} <= robot.keys():
        raise Failure("a costmap needs --floor, --height and --radius", BAD_INPUT)
    if suffix not in COSTMAPS and robot:
        raise Failure(f"--{next(iter(robot))} is for {' and '.join(COSTMAPS)}", BAD_INPUT)
    state = checked(lambda: load(options.map))
    robot = {f"{name}_m": value for name, value in robot.items()}
    checked(lambda: export_map(options.to, state, options.resolution, **robot))


def _export_metrics(source: Path, target: Path) -> None:
    import json

    from hiosdf_jax._src.scoring.rows import write_csv

    text = checked(source.read_bytes)
    try:
        metrics = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise Failure(f"{source}: expected the metrics.json of a run", BAD_INPUT) from error
    checked(lambda: write_csv(target, metrics))


def _eval(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.command.map_scores import score_map
    from hiosdf_jax._src.command.report import write_json
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.scoring import table

    if options.to is not None:
        checked(lambda: check_output(options.to))
    state = checked(lambda: load(options.map))
    stream, truth = open_inputs(options)
    if options.ground_truth is not None:
        truth, _ = truth_of_scene(options.ground_truth, stream, state.config.max_range)
    if truth is None:
        reason = "has no exact distances, expected --ground-truth"
        raise Failure(f"{options.stream} {reason}", BAD_INPUT)
    scores = checked(lambda: score_map(options.map, state, truth))
    texts = [table.format_table(scores["scores"]), table.format_bands(scores["bands"])]
    if "not_scored" in scores:
        texts.insert(1, table.format_reasons(scores["not_scored"]))
    print("\n\n".join(texts))
    if options.to is not None:
        write_json(options.to, scores)
        print(f"\nwrote {options.to}")


def _info(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.command.map_info import describe_map
    from hiosdf_jax._src.mapping.checkpoint import load

    state = checked(lambda: load(options.map))
    print(checked(lambda: describe_map(options.map, state)))


def _bench(options: argparse.Namespace) -> None:
    if options.json is not None:
        checked(lambda: check_output(options.json))
    from hiosdf_jax._src.command import bench
    from hiosdf_jax._src.command.report import write_json
    from hiosdf_jax._src.demo import apartment

    stream = apartment.ApartmentStream(frames=bench.FRAMES)
    config = configure(options.config, apartment.BOUNDS_WORLD, max_range=stream.max_range)
    begin("updates and queries of a map of the demo's apartment, about a minute on two CPU cores")
    record = bench.measure(stream, config)
    print(bench.format_record(record))
    if options.json is not None:
        write_json(options.json, record)
        print(f"\nwrote {options.json}")


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": _demo,
    "map": _map,
    "eval": _eval,
    "view": _view,
    "export": _export,
    "info": _info,
    "bench": _bench,
}
