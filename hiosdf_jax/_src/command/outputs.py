"""Checks, before any work, that the outputs of the command can be written."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from hiosdf_jax._src.command.failures import BAD_INPUT, Failure, checked
from hiosdf_jax._src.output_files import check_output, check_output_folder


def check_outputs(options: argparse.Namespace, output: Path) -> None:
    """Raises a failure for outputs that cannot be written, before any work."""
    from hiosdf_jax._src.command.map_file import UNFINISHED
    from hiosdf_jax._src.command.map_stream import RESULTS

    check_folder(options, output, (*RESULTS, UNFINISHED))
    if options.export is not None:
        checked(lambda: check_output(options.export))
    if options.save is None:
        return
    checked(lambda: check_output(options.save))
    inputs = [getattr(options, name, None) for name in ("stream", "ground_truth", "trajectory")]
    for other in (*filter(None, inputs), *(output / name for name in RESULTS)):
        if options.save.resolve() == other.resolve():
            raise Failure(f"--save {options.save} would replace {other}", BAD_INPUT)
    if options.save.is_file() and not is_map(options.save):
        raise Failure(f"--save {options.save} would replace a file that is not a map", BAD_INPUT)


def is_map(path: Path) -> bool:
    from hiosdf_jax._src.mapping.checkpoint import is_map

    return is_map(path)


def check_folder(options: argparse.Namespace, output: Path, names: Sequence[str]) -> None:
    """Raises a failure if results cannot go to a folder, or would become part of a recording."""
    checked(lambda: check_output_folder(output, names))
    if not output.is_dir():
        return
    from hiosdf_jax._src.datasets.open import holds_recording

    stream = getattr(options, "stream", None)
    is_stream = stream and output.resolve() == stream.resolve()
    if is_stream or checked(lambda: holds_recording(output, apart=["mesh.ply"])):
        raise Failure(f"{output}: holds a recording, expected a folder for results", BAD_INPUT)
