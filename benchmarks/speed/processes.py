"""Tasks that measure processes of their own: a whole run of `hiosdf map`, and imports."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import hiosdf_jax as hio
from benchmarks.speed.rows import Baseline, Measured, Row, single, spread_of

_HIOSDF = "import sys; from hiosdf_jax._src.command.cli import main; sys.exit(main(sys.argv[1:]))"


def run_command(stream: Path) -> Measured:
    """Measures time and peak memory of `hiosdf map` over a stream.

    Must run before everything else: a process counts as its own peak what its parent holds.

    Args:
        stream: The file.

    Returns:
        Rows in s and MB.
    """
    with tempfile.TemporaryDirectory() as output:
        command = [sys.executable, "-c", _HIOSDF, "map", str(stream)]
        command += ["--config", "light", "--output", output]
        start = time.perf_counter()
        process = subprocess.Popen(
            command,
            env=_environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        took_s = time.perf_counter() - start
    if status != 0:
        raise RuntimeError(f"hiosdf map ended with exit code {os.waitstatus_to_exitcode(status)}")
    return Measured(
        [
            Row("hiosdf map, the whole stream, light", "s", single(took_s)),
            Row("resident memory, peak of hiosdf map", "MB", single(resident_mb(usage))),
        ]
    )


def import_package(repeats: int) -> Measured:
    """Times the import of the package, beside that of the packages it needs.

    Args:
        repeats: Number of processes for each.

    Returns:
        A row in s.
    """
    environment = _environment()

    def seconds(names: str) -> float:
        code = f"import time; t = time.perf_counter(); import {names}; print(time.perf_counter()-t)"
        command = [sys.executable, "-c", code]
        return float(subprocess.check_output(command, env=environment, text=True, timeout=120))

    needed, ours = "jax, flax, optax", "hiosdf_jax"
    seconds(ours)  # files are read and compiled to bytecode once
    pairs = [(seconds(needed), seconds(ours)) for _ in range(repeats)]
    base, own = (spread_of(column) for column in zip(*pairs, strict=True))
    row = Row("import hiosdf_jax", "s", own, compare="import")
    return Measured([row], {"import": [Baseline(f"import {needed}", base)]})


def resident_mb(usage: resource.struct_rusage) -> float:
    """Returns the peak of resident memory, which is in KiB on Linux and in bytes on macOS."""
    return 1e-6 * usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _environment() -> dict[str, str]:
    """The environment in which a process imports the same package as this one."""
    root = Path(hio.__file__).parents[1]
    paths = [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
