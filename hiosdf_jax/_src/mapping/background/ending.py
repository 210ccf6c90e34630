"""The end of the interpreter while one of its threads traces, compiles or computes."""

from __future__ import annotations

import ctypes
import signal
import threading

_WAIT_S = 1.0
_HANG_S = 5


def end_with_interpreter(thread: threading.Thread) -> None:
    """Ends a daemon thread that would crash the interpreter's exit. Call it from `atexit`.

    The thread gets a SystemExit, which ends Python code such as JAX's tracing at once. XLA cannot
    be interrupted. Where it compiles for longer than a second, the process ends without waiting
    for the thread, with the exit code that the script has. That needs `on_exit` of glibc: elsewhere
    this waits.

    Args:
        thread: The thread.

    Example:
        >>> atexit.register(end_with_interpreter, thread)
    """
    if thread.ident is not None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(
            ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit)
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
    # Until then the interpreter is torn down, and Python before 3.14 unwinds a thread that comes
    # back from XLA in this time through frames that do not allow it. Such a thread then sleeps.
    libc.signal.restype = ctypes.c_void_p
    for fault in (signal.SIGABRT, signal.SIGSEGV):
        libc.signal(fault, libc.pause)
    libc.alarm(_HANG_S)  # and nothing waits for it for ever
