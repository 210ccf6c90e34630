"""Pauses Python's garbage collector, which JAX's tracing of a large function calls many times."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pauses the garbage collector around a call that may trace and compile.

    Other threads of the process are not collected meanwhile, either. A collector that was off stays
    off.

    Example:
        >>> with collector_paused():
        ...     return compiled(state, cloud, pose)
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
