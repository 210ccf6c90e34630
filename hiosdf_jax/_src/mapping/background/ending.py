"""The end of the interpreter while one of its threads traces, compiles or computes."""

from __future__ import annotations

import ctypes
import faulthandler
import signal
import threading

_WAIT_S = 1.0
_HANG_S = 60  # functions that were registered with `atexit` earlier run in this time


def end_with_interpreter(thread: threading.Thread) -> None:
    """Ends a daemon thread that would crash the interpreter's exit. Call it from `atexit`.

    The thread gets a SystemExit, which ends Python code such as JAX's tracing at once. XLA cannot
    be interrupted. Where it compiles for longer than a second, the process ends without waiting
    for the thread, with the exit code that the script has. That needs `on_exit` of glibc: elsewhere
    this waits. If the rest of the exit takes longer than a minute, SIGALRM ends the process. A
    program that embeds Python and outlives it has to close its mapper.

    Args:
        thread: The thread.

    Example:
        >>> atexit.register(end_with_interpreter, thread)
    """
    if not thread.is_alive():
        return
    ctypes.pythonapi.PyThreadState_SetAsyncExc(
        ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
    )
    thread.join(_WAIT_S)
    if not thread.is_alive():
        return
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "on_exit"):
        thread.join()
        return
    # `_exit` with the exit code, before destructors of C++ free what the thread still uses.
    libc.on_exit(libc._exit, None)
    # Until then the interpreter is torn down. Before Python 3.14, a thread that returns from XLA
    # in this time is unwound through frames that must not be unwound, which aborts the process.
    # Such a thread sleeps instead.
    faulthandler.disable()  # it would restore the old handlers during the teardown
    libc.signal.restype = ctypes.c_void_p
    for fault in (signal.SIGABRT, signal.SIGSEGV):
        libc.signal(fault, libc.pause)
    # If the teardown hangs, this ends the process.
    libc.signal(signal.SIGALRM, None)
    libc.alarm(_HANG_S)
