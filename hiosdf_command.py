"""Starts the `hiosdf` command.

This lies outside the package, whose import takes a second or more: Ctrl-C in that time ends the
command with one line and not with a traceback.
"""

from __future__ import annotations

import gc
import os
import signal
from typing import NoReturn


def main() -> int:
    """Runs the command; see `hiosdf_jax._src.command.cli.main`."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored, as by nohup
        signal.signal(signal.SIGINT, _stop)  # until the command receives its signals itself
    # Tracing makes many small objects. With Python's own thresholds, half of its time is garbage
    # collection.
    gc.set_threshold(100_000, 50, 100)
    from hiosdf_jax._src.command import cli

    return cli.main()


def _stop(number: int, _: object) -> NoReturn:
    # No exception: where it meets an import, libraries turn it into others.
    os.write(2, b"hiosdf: stopped\n")
    os._exit(128 + number)
