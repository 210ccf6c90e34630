"""Runs the mapping of `hiosdf demo` and `hiosdf map`, and says how it ended."""

from __future__ import annotations

import argparse
import itertools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiosdf_jax._src.command.failures import BAD_INPUT, NOTHING_MAPPED, SKIP_HINT, Failure
from hiosdf_jax._src.command.watching import begin_watch, end_watch

# Heavy imports are inside the functions, so that `hiosdf --help` responds at once.
if TYPE_CHECKING:
    from hiosdf_jax._src.command.progress import SavedMap
    from hiosdf_jax._src.config import Config
    from hiosdf_jax._src.datasets.stream import Stream
    from hiosdf_jax._src.datasets.truth import GroundTruth


def run_mapping(
    options: argparse.Namespace,
    stream: Stream,
    config: Config,
    output: Path,
    *,
    truth: GroundTruth | None,
    resumed: SavedMap | None,
    **settings: Any,
) -> None:
    """Maps, scores and draws; turns what ends the mapping into a failure or a hint to resume."""
    from hiosdf_jax._src.command import map_stream
    from hiosdf_jax._src.command.map_file import path_of_map
    from hiosdf_jax._src.command.map_frames import NothingMappedError
    from hiosdf_jax._src.command.stream_frames import OtherStreamError, StoppedError
    from hiosdf_jax._src.datasets.stream import BadFrameError

    if truth is not None and not (truth.frame < len(stream)).any():
        first = f"begin with frame {truth.frame.min()}" if len(truth.frame) else "are none"
        raise Failure(
            f"the exact distances {first}, but the stream has {len(stream)} frames", BAD_INPUT
        )
    if resumed is not None and resumed.held_out != (truth is None):
        was = "without" if resumed.held_out else "with"
        raise Failure(f"{options.resume} was mapped {was} exact distances", BAD_INPUT)
    live = begin_watch(options, stream, settings["exact_sdf"], output)
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
        raise Failure(f"{error}{SKIP_HINT}", BAD_INPUT) from error
    except NothingMappedError as error:
        raise Failure(error, NOTHING_MAPPED) from error
    except OtherStreamError as error:
        raise Failure(f"{options.resume}: {error}", BAD_INPUT) from error
    except StoppedError as stop:
        if not stop.mapped:
            raise KeyboardInterrupt from stop
        if settings.get("tracker") is not None:
            print(f"stopped by {stop}")
        else:
            map_path = str(path_of_map(output, options.save))
            command, *rest = _without_resume(options.arguments)
            again = shlex.join(["hiosdf", command, "--resume", map_path, *rest])
            print(f"stopped by {stop}; to resume:\n  {again}")
    if live is not None:
        end_watch(options, live)


def _without_resume(arguments: Sequence[str]) -> list[str]:
    """The arguments without the option --resume and its value."""
    kept = []
    names = itertools.takewhile(lambda argument: argument != "--", arguments)
    for argument, before in zip(names, ["", *arguments], strict=False):
        if "--resume" not in (argument, before) and not argument.startswith("--resume="):
            kept.append(argument)
    return kept + list(itertools.dropwhile(lambda argument: argument != "--", arguments))
