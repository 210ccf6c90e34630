"""The view of a map in a browser while a command runs, and after it."""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hiosdf_jax._src.command.failures import checked
from hiosdf_jax._src.command.stopping import Stopping

# Heavy imports are inside the functions, so that `hiosdf --help` responds at once.
if TYPE_CHECKING:
    import numpy as np

    from hiosdf_jax._src.command.live_map import LiveMap
    from hiosdf_jax._src.datasets.stream import Stream


def begin_watch(
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
    live = checked(lambda: LiveMap(stream, exact_sdf, options.host, port, button))
    if options.view:
        print(f"the map grows at {live.url}", flush=True)
    return live


def end_watch(options: argparse.Namespace, live: LiveMap) -> None:
    """Writes the view if it is to be written, and lets it live on if it is watched."""
    if options.export is not None:
        checked(lambda: live.export(options.export))
        print(f"wrote {options.export}")
    if options.view and options.stopping.received is None:
        wait_for_signal(options.stopping, live.url)
    live.close()


def wait_for_signal(stopping: Stopping, url: str) -> None:
    """Lets a view live until a signal; Ctrl-C is its usual end."""
    stopping.in_order()
    print(f"the view is at {url} until Ctrl-C", flush=True)
    while stopping.received is None:
        time.sleep(0.1)
    if stopping.received == signal.SIGINT:
        stopping.received = None
