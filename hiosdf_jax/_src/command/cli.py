"""The `hiosdf` command: `hiosdf demo | map | eval | view | export | info | bench`."""

from __future__ import annotations

import argparse
import importlib
import itertools
import math
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiosdf_jax._src.command.arguments import DEMO_FRAMES, parser_of
from hiosdf_jax._src.command.console import LastingText, lasting
from hiosdf_jax._src.command.stopping import Stopping
from hiosdf_jax._src.output_files import check_output, check_output_folder, replacing_together

# Heavy imports are inside the functions, so that `hiosdf --help` responds at once.
if TYPE_CHECKING:
    import numpy as np

    from hiosdf_jax._src.command.live_map import LiveMap
    from hiosdf_jax._src.command.progress import SavedMap
    from hiosdf_jax._src.command.tracker import Tracker
    from hiosdf_jax._src.config import Config
    from hiosdf_jax._src.datasets.stream import Stream
    from hiosdf_jax._src.datasets.truth import GroundTruth

_NOTHING_MAPPED, _NOT_REACHED, _BAD_INPUT = 1, 1, 2  # exit codes; argparse itself exits with 2
_OUTPUT = Path("hiosdf_output")
_MOST_DEMO_FRAMES = 100_000
_MOST_PORT = 65535
_MOST_SEED = 2**32 - 1  # JAX drops higher bits
_PLAN_RESULTS = ("plan.png", "plan.gif", "metrics.json")
_SKIP_HINT = " (--skip-bad-frames skips such frames)"


class _Failure(Exception):
    """Ends the command with one line on stderr and an exit code."""

    def __init__(self, message: object, code: int) -> None:
        super().__init__(message)
        self.code = code


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
            _check_console(out)
            _check_numbers(options)
            options.command(options)
            _check_console(out)
        except _Failure as failure:
            print(f"hiosdf: {failure}", file=sys.stderr)
            return failure.code
        except (OSError, MemoryError) as error:
            print(f"hiosdf: {_message(error) or 'out of memory'}", file=sys.stderr)
            return _BAD_INPUT
        except RuntimeError as error:  # what JAX raises, whose import takes a second
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            print("hiosdf: out of memory; a smaller map takes less", file=sys.stderr)
            return _BAD_INPUT
        except KeyboardInterrupt:
            print("hiosdf: stopped; nothing was written", file=sys.stderr)
            return 128 + (stopping.received or signal.SIGINT)
    return 0 if stopping.received is None else 128 + stopping.received


def _check_console(out: Any) -> None:
    """Raises a failure if standard output is closed, or its reader has gone."""
    if out is None:
        raise _Failure("standard output is closed", _BAD_INPUT)
    out.flush()
    if isinstance(out, LastingText) and out.failure is not None:
        raise _Failure(f"standard output: {out.failure.strerror}", _BAD_INPUT)


def _check_numbers(options: argparse.Namespace) -> None:
    """Raises a failure for numbers too large to count with."""
    most = {"seed": _MOST_SEED, "port": _MOST_PORT}
    if options.command is _demo:
        most["frames"] = _MOST_DEMO_FRAMES
    for name, limit in most.items():
        value = getattr(options, name, None)
        if value is not None and value > limit:
            raise _Failure(f"--{name} is {value}, expected at most {limit}", _BAD_INPUT)


def _begin(text: str) -> None:
    """Prints the first line of a run; fails, before any work, if nobody can read it."""
    print(text)
    _check_console(sys.stdout)


def _demo(options: argparse.Namespace) -> None:
    if options.plan:
        _plan(options)
        return
    output = options.output or _OUTPUT / "demo"
    _check_outputs(options, output)
    resumed = _resume(options)
    from hiosdf_jax._src.demo import apartment
    from hiosdf_jax._src.demo.primitives import signed_distance

    frames = options.frames or DEMO_FRAMES
    seed = _seed(options, resumed)
    stream = apartment.ApartmentStream(frames=frames, seed=seed)
    if resumed is None:
        config = _configure(options.config, apartment.BOUNDS_WORLD, max_range=stream.max_range)
    else:
        config = resumed.state.config
    _begin(f"{len(stream)} frames of a depth camera carried through a furnished apartment")
    _run(
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
            raise _Failure(f"{_option(name)} cannot be combined with --plan", _BAD_INPUT)
    output = options.output or _OUTPUT / "demo_plan"
    _check_folder(options, output, _PLAN_RESULTS)
    try:
        importlib.import_module("skimage.graph")  # the search for paths needs it later
        from hiosdf_jax._src.demo import exploration, picture
    except ModuleNotFoundError as error:
        packages = {"jax_mppi": "jax-mppi", "skimage": "scikit-image"}
        package = packages.get((error.name or "").partition(".")[0])
        if package is None:
            raise
        hint = f"--plan needs {package}: in a clone, pip install '.[plan]'"
        raise _Failure(hint, _BAD_INPUT) from error

    _begin("a robot explores an apartment that it does not know")
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
        raise _Failure("the robot collided", _NOT_REACHED)
    if not metrics["reached"]:
        raise _Failure("the robot did not reach its goal", _NOT_REACHED)


def _map(options: argparse.Namespace) -> None:
    place = options.stream.absolute()
    tracking = "--odometry" if options.odometry else "--refine-poses"
    if options.resume is not None and (options.odometry or options.refine_poses):
        raise _Failure(
            f"--resume cannot be combined with {tracking}: maps have no poses", _BAD_INPUT
        )
    output = options.output or _OUTPUT / (place.name if place.is_dir() else place.stem)
    _check_outputs(options, output)
    if options.ground_truth is not None and not options.ground_truth.exists():
        raise _Failure(f"{options.ground_truth}: No such file or folder", _BAD_INPUT)
    overrides = {"max_range": options.max_range, "voxel_size": options.voxel_size}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    bounds = None
    if options.bounds is not None:
        bounds = (tuple(options.bounds[:3]), tuple(options.bounds[3:]))
    # Checked before minutes are spent on reading; the bounds may still be unknown.
    _configure(options.config, bounds or ((0, 0, 0), (10, 10, 10)), **overrides)
    resumed = _resume(options)
    stream, truth = _open(options)
    _begin(f"{place.name}: {len(stream)} frames")
    if resumed is not None:
        config = resumed.state.config
    else:
        if bounds is None or options.max_range is None:
            bounds, overrides["max_range"] = _complete(bounds, options, stream)
        config = _configure(options.config, bounds, **overrides)
    exact_sdf = None
    if options.ground_truth is not None:
        truth, exact_sdf = _sample_truth(options.ground_truth, stream, config.max_range)
    _run(
        options,
        stream,
        config,
        output,
        name=place.name,
        seed=_seed(options, resumed),
        truth=truth,
        exact_sdf=exact_sdf,
        skip_bad_frames=options.skip_bad_frames,
        resumed=resumed,
        tracker=_tracker(options),
    )


def _tracker(options: argparse.Namespace) -> Tracker | None:
    if not (options.odometry or options.refine_poses):
        return None
    from hiosdf_jax._src.command.tracker import Tracker

    return Tracker(options.odometry)


def _view(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.mapping.pipeline import snapshot
    from hiosdf_jax._src.view.live import Viewer

    if options.export is not None:
        _checked(lambda: check_output(options.export))
    state = _checked(lambda: load(options.map))
    port = 0 if options.export is not None else options.port
    viewer = _checked(lambda: Viewer(host=options.host, port=port))
    viewer.show(snapshot(state))
    if options.export is not None:
        _checked(lambda: viewer.export(options.export))
        print(f"wrote {options.export}")
    else:
        _wait(options, viewer.url)
    viewer.close()


def _wait(options: argparse.Namespace, url: str) -> None:
    """Lets a view live until a signal; Ctrl-C is its usual end."""
    options.stopping.in_order()
    print(f"the view is at {url} until Ctrl-C", flush=True)
    while options.stopping.received is None:
        time.sleep(0.1)
    if options.stopping.received == signal.SIGINT:
        options.stopping.received = None


def _export(options: argparse.Namespace) -> None:
    _checked(lambda: check_output(options.to))
    if options.to.is_file() and _is_map(options.to):
        raise _Failure(f"--to {options.to} would replace a map", _BAD_INPUT)
    if options.to.suffix == ".csv":
        _export_metrics(options.map, options.to)
    else:
        _export_map(options)
    print(f"wrote {options.to}")


def _export_map(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.view.exports.by_suffix import COSTMAPS, check_suffix, export_map

    suffix = _checked(lambda: check_suffix(options.to))
    names = ("floor", "height", "radius", "step")
    robot = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if suffix in COSTMAPS and not {"floor", "height", "radius"} <= robot.keys():
        raise _Failure("a costmap needs --floor, --height and --radius", _BAD_INPUT)
    if suffix not in COSTMAPS and robot:
        raise _Failure(f"--{next(iter(robot))} is for {' and '.join(COSTMAPS)}", _BAD_INPUT)
    state = _checked(lambda: load(options.map))
    robot = {f"{name}_m": value for name, value in robot.items()}
    _checked(lambda: export_map(options.to, state, options.resolution, **robot))


def _export_metrics(source: Path, target: Path) -> None:
    import json

    from hiosdf_jax._src.scoring.rows import write_csv

    text = _checked(source.read_bytes)
    try:
        metrics = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _Failure(f"{source}: expected the metrics.json of a run", _BAD_INPUT) from error
    _checked(lambda: write_csv(target, metrics))


def _eval(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.command.map_scores import score_map
    from hiosdf_jax._src.command.report import write_json
    from hiosdf_jax._src.mapping.checkpoint import load
    from hiosdf_jax._src.scoring import table

    if options.to is not None:
        _checked(lambda: check_output(options.to))
    state = _checked(lambda: load(options.map))
    stream, truth = _open(options)
    if options.ground_truth is not None:
        truth, _ = _sample_truth(options.ground_truth, stream, state.config.max_range)
    if truth is None:
        reason = "has no exact distances, expected --ground-truth"
        raise _Failure(f"{options.stream} {reason}", _BAD_INPUT)
    scores = _checked(lambda: score_map(options.map, state, truth))
    print(f"{table.format_table(scores['scores'])}\n\n{table.format_bands(scores['bands'])}")
    if options.to is not None:
        write_json(options.to, scores)
        print(f"\nwrote {options.to}")


def _info(options: argparse.Namespace) -> None:
    from hiosdf_jax._src.command.map_info import describe_map
    from hiosdf_jax._src.mapping.checkpoint import load

    state = _checked(lambda: load(options.map))
    print(_checked(lambda: describe_map(options.map, state)))


def _bench(options: argparse.Namespace) -> None:
    if options.json is not None:
        _checked(lambda: check_output(options.json))
    from hiosdf_jax._src.command import bench
    from hiosdf_jax._src.command.report import write_json
    from hiosdf_jax._src.demo import apartment

    stream = apartment.ApartmentStream(frames=bench.FRAMES)
    config = _configure(options.config, apartment.BOUNDS_WORLD, max_range=stream.max_range)
    _begin("updates and queries of a map of the demo's apartment, about a minute on two CPU cores")
    record = bench.measure(stream, config)
    print(bench.format_record(record))
    if options.json is not None:
        write_json(options.json, record)
        print(f"\nwrote {options.json}")


def _check_outputs(options: argparse.Namespace, output: Path) -> None:
    """Raises a failure for outputs that cannot be written, before any work."""
    from hiosdf_jax._src.command.map_stream import RESULTS, UNFINISHED

    _check_folder(options, output, (*RESULTS, UNFINISHED))
    if options.export is not None:
        _checked(lambda: check_output(options.export))
    if options.save is None:
        return
    _checked(lambda: check_output(options.save))
    inputs = [getattr(options, name, None) for name in ("stream", "ground_truth", "trajectory")]
    for other in (*filter(None, inputs), *(output / name for name in RESULTS)):
        if options.save.resolve() == other.resolve():
            raise _Failure(f"--save {options.save} would replace {other}", _BAD_INPUT)
    if options.save.is_file() and not _is_map(options.save):
        raise _Failure(f"--save {options.save} would replace a file that is no map", _BAD_INPUT)


def _is_map(path: Path) -> bool:
    from hiosdf_jax._src.mapping.checkpoint import is_map

    return is_map(path)


def _check_folder(options: argparse.Namespace, output: Path, names: Sequence[str]) -> None:
    """Raises a failure if results cannot go to a folder, or would become part of a recording."""
    _checked(lambda: check_output_folder(output, names))
    if not output.is_dir():
        return
    from hiosdf_jax._src.datasets.open import holds_recording

    stream = getattr(options, "stream", None)
    is_stream = stream and output.resolve() == stream.resolve()
    if is_stream or _checked(lambda: holds_recording(output, apart=["mesh.ply"])):
        raise _Failure(f"{output}: holds a recording, expected a folder for results", _BAD_INPUT)


def _resume(options: argparse.Namespace) -> SavedMap | None:
    """The map to go on with; raises a failure if it contradicts the other options."""
    if options.resume is None:
        return None
    from hiosdf_jax._src.command.progress import load_map
    from hiosdf_jax._src.config import Config

    resumed = _checked(lambda: load_map(options.resume))
    config = resumed.state.config
    sizes = {"voxel_size": config.voxel_size, "max_range": config.max_range}
    known = {"seed": resumed.seed, "bounds": [*config.bounds[0], *config.bounds[1]]} | sizes
    for name, value in known.items():
        given = getattr(options, name, None)
        if given is not None and given != value:
            raise _Failure(
                f"{_option(name)} is {given}, expected {value} as in {options.resume}", _BAD_INPUT
            )
    if options.config and getattr(Config, options.config)(config.bounds, **sizes) != config:
        raise _Failure(f"--config is {options.config}, not that of {options.resume}", _BAD_INPUT)
    return resumed


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def _seed(options: argparse.Namespace, resumed: SavedMap | None) -> int:
    return (options.seed or 0) if resumed is None else resumed.seed


def _open(options: argparse.Namespace) -> tuple[Stream, GroundTruth | None]:
    """Opens the stream, with the exact distances of its file unless others are given."""
    from hiosdf_jax._src.datasets.npz import NpzStream, read_truth
    from hiosdf_jax._src.datasets.open import open_stream
    from hiosdf_jax._src.datasets.stream import FrameStream

    names = ("intrinsics", "trajectory", "cloud_topic", "odometry_topic", "world_frame")
    chosen = {name: getattr(options, name, None) for name in names}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    stream = _checked(lambda: open_stream(options.stream, options.format, **chosen))
    truth = None
    if isinstance(stream, NpzStream) and options.ground_truth is None:
        truth = _checked(lambda: read_truth(options.stream))
    if options.frames is not None:
        count = min(options.frames, len(stream))
        stream = FrameStream(options.stream, count, stream.__getitem__)
    return stream, truth


def _complete(bounds: Any, options: argparse.Namespace, stream: Stream) -> tuple[Any, float]:
    """Completes bounds and range of the sensor in a first reading of the stream."""
    from hiosdf_jax._src.datasets.stream import find_bounds

    extent = _checked(
        lambda: find_bounds(stream, skip_bad_frames=options.skip_bad_frames), code=_NOTHING_MAPPED
    )
    bounds = bounds or extent.bounds
    if not math.isfinite(sum(map(sum, bounds)) + extent.max_range):
        raise _Failure(
            "the returns are too far to find bounds, expected --bounds and --max-range", _BAD_INPUT
        )
    max_range = options.max_range or math.ceil(10 * extent.max_range) / 10
    (x0, y0, z0), (x1, y1, z1) = bounds
    print(
        f"bounds x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}, z {z0:.1f} to {z1:.1f} m; "
        f"returns up to {max_range:.1f} m"
    )
    return bounds, max_range


def _sample_truth(
    file: Path, stream: Stream, max_range: float
) -> tuple[GroundTruth, Callable[[np.ndarray], np.ndarray]]:
    """Exact distances of a scene where the stream observed it, and the distances to draw."""
    from hiosdf_jax._src.scoring import scene, visible

    rays = _checked(lambda: visible.read_rays(stream, max_range), code=_NOTHING_MAPPED)
    exact = _checked(lambda: scene.read_scene(file, visible.sensor_path(rays)))
    truth = _checked(lambda: visible.sample_visible(exact, rays))
    return truth, exact.sdf_to_draw


def _configure(name: str | None, bounds: Any, **overrides: float) -> Config:
    import jax

    from hiosdf_jax._src.config import Config

    if name is None:
        name = "light" if jax.default_backend() == "cpu" else "default"
    return _checked(lambda: getattr(Config, name)(bounds, **overrides))


def _run(
    options: argparse.Namespace,
    stream: Stream,
    config: Config,
    output: Path,
    *,
    truth: GroundTruth | None,
    resumed: SavedMap | None,
    **settings: Any,
) -> None:
    """Maps, scores and draws; turns what ends the mapping into a failure or a hint to go on."""
    from hiosdf_jax._src.command import map_stream
    from hiosdf_jax._src.command.map_frames import (
        NothingMappedError,
        OtherStreamError,
        StoppedError,
    )
    from hiosdf_jax._src.datasets.stream import BadFrameError

    if truth is not None and not (truth.frame < len(stream)).any():
        first = f"begin with frame {truth.frame.min()}" if len(truth.frame) else "are none"
        raise _Failure(
            f"the exact distances {first}, but the stream has {len(stream)} frames", _BAD_INPUT
        )
    if resumed is not None and resumed.held_out != (truth is None):
        was = "without" if resumed.held_out else "with"
        raise _Failure(f"{options.resume} was mapped {was} exact distances", _BAD_INPUT)
    live = _watch(options, stream, settings["exact_sdf"], output)
    options.stopping.in_order()
    try:
        map_stream.run_stream(
            stream,
            config,
            output,
            truth=truth,
            resumed=resumed,
            resume_path=options.resume,
            save_path=options.save,
            checkpoint_every=options.checkpoint_every,
            stop=lambda: options.stopping.received and options.stopping.received.name,
            live=live,
            **settings,
        )
    except BadFrameError as error:
        raise _Failure(f"{error}{_SKIP_HINT}", _BAD_INPUT) from error
    except NothingMappedError as error:
        raise _Failure(error, _NOTHING_MAPPED) from error
    except OtherStreamError as error:
        raise _Failure(f"{options.resume}: {error}", _BAD_INPUT) from error
    except StoppedError as stop:
        if not stop.mapped:
            raise KeyboardInterrupt from stop
        if settings.get("tracker") is not None:
            print(f"stopped by {stop}")
        else:
            map_path = str(map_stream.map_file(output, options.save))
            command, *rest = _without_resume(options.arguments)
            again = shlex.join(["hiosdf", command, "--resume", map_path, *rest])
            print(f"stopped by {stop}; to go on:\n  {again}")
    if live is not None:
        _end_watch(options, live)


def _watch(
    options: argparse.Namespace,
    stream: Stream,
    exact_sdf: Callable[[np.ndarray], np.ndarray] | None,
    output: Path,
) -> LiveMap | None:
    """Starts the view of a growing map, if there is to be one."""
    if not options.view and options.export is None:
        return None
    from hiosdf_jax._src.command.live_map import LiveMap

    port = options.port if options.view else 0
    button = options.export or output / "scene.html"
    live = _checked(lambda: LiveMap(stream, exact_sdf, options.host, port, button))
    if options.view:
        print(f"the map grows at {live.url}", flush=True)
    return live


def _end_watch(options: argparse.Namespace, live: LiveMap) -> None:
    """Writes the view if it is to be written, and lets it live on if it is watched."""
    if options.export is not None:
        _checked(lambda: live.export(options.export))
        print(f"wrote {options.export}")
    if options.view and options.stopping.received is None:
        _wait(options, live.url)
    live.close()


def _without_resume(arguments: Sequence[str]) -> list[str]:
    """The arguments without the option --resume and its value."""
    kept = []
    names = itertools.takewhile(lambda argument: argument != "--", arguments)
    for argument, before in zip(names, ["", *arguments], strict=False):
        if "--resume" not in (argument, before) and not argument.startswith("--resume="):
            kept.append(argument)
    return kept + list(itertools.dropwhile(lambda argument: argument != "--", arguments))


def _checked[Result](call: Callable[[], Result], code: int = _BAD_INPUT) -> Result:
    """Calls a function, and turns its errors into a failure with a message of one line."""
    from hiosdf_jax._src.datasets.stream import BadFrameError

    try:
        return call()
    except BadFrameError as error:
        raise _Failure(f"{error}{_SKIP_HINT}", _BAD_INPUT) from error
    except (OSError, ValueError, ModuleNotFoundError) as error:
        raise _Failure(_message(error), code) from error


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fspath(error.filename)}: {error.strerror}"
    return " ".join(str(error).split())


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": _demo,
    "map": _map,
    "eval": _eval,
    "view": _view,
    "export": _export,
    "info": _info,
    "bench": _bench,
}
