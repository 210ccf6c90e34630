"""SIGINT, SIGTERM and SIGHUP: the first one ends a run in order, the second one at once."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last one of a closed terminal


class Stopping:
    """Receives SIGINT, SIGTERM and SIGHUP while a command runs.

    Before `in_order` is called, a signal raises KeyboardInterrupt. Afterward the first one is only
    noted in `received`, and the run ends when it can. The second one always has its default effect:
    it ends the process. A signal that the process ignores, such as SIGHUP under `nohup`, stays
    ignored.

    Attributes:
        received: The signal that has arrived, or None.

    Example:
        with Stopping() as stopping:
            stopping.in_order()
            while stopping.received is None:
                work()
    """

    def __init__(self) -> None:
        """Notes nothing yet."""
        self.received: signal.Signals | None = None
        self._in_order = False
        self._before: dict[signal.Signals, Any] = {}

    def in_order(self) -> None:
        """Lets the run end by itself once a signal has arrived."""
        self._in_order = True

    def __enter__(self) -> Stopping:
        """Begins to receive signals; without effect outside the main thread."""
        if threading.current_thread() is threading.main_thread():
            for each in _SIGNALS:
                if signal.getsignal(each) not in (signal.SIG_IGN, None):
                    self._before[each] = signal.signal(each, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        """Restores what signals did before."""
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.received = signal.Signals(number)
        for each in self._before:
            signal.signal(each, signal.SIG_DFL)
        if not self._in_order:
            raise KeyboardInterrupt
