"""Standard output and standard error whose loss does not end a run."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO

from hiosdf_jax._src.command.failures import BAD_INPUT, Failure


class LastingText:
    """A text stream that notes a failure to write and continues without writing.

    Attributes:
        failure: The first failure, or None.
    """

    def __init__(self, stream: TextIO) -> None:
        """Wraps a stream."""
        self.failure: OSError | None = None
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes, unless that has failed before."""
        if self.failure is None:
            try:
                return self._stream.write(text)
            except UnicodeEncodeError:  # a file's name that the terminal cannot show
                self._stream.write(text.encode("ascii", "backslashreplace").decode())
            except OSError as error:
                self.failure = error
        return len(text)

    def flush(self) -> None:
        """Flushes, unless writing has failed before."""
        if self.failure is None:
            try:
                self._stream.flush()
            except OSError as error:
                self.failure = error

    def __getattr__(self, name: str) -> Any:
        """Everything else is that of the stream."""
        return getattr(self._stream, name)


@contextlib.contextmanager
def lasting() -> Iterator[LastingText | None]:
    """Replaces `sys.stdout` and `sys.stderr` while a command runs.

    Yields:
        The new standard output; None if the process was started without one.
    """
    out = None if sys.stdout is None else LastingText(sys.stdout)
    with contextlib.ExitStack() as stack:
        errors = sys.stderr or stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        error = LastingText(errors)
        stack.enter_context(contextlib.redirect_stderr(error))  # pyright: ignore[reportArgumentType]
        stack.enter_context(contextlib.redirect_stdout(out))  # pyright: ignore[reportArgumentType]
        yield out
        for each in filter(None, (out, error)):
            each.flush()
            if each.failure is not None:
                _silence(each)


def check_console(out: Any) -> None:
    """Raises a failure if standard output is closed, or its reader has gone."""
    if out is None:
        raise Failure("standard output is closed", BAD_INPUT)
    out.flush()
    if isinstance(out, LastingText) and out.failure is not None:
        raise Failure(f"standard output: {out.failure.strerror}", BAD_INPUT)


def begin(text: str) -> None:
    """Prints the first line of a run; fails, before any work, if nobody can read it."""
    print(text)
    check_console(sys.stdout)


def _silence(stream: LastingText) -> None:
    """Lets what is left in the buffer vanish; Python would fail to write it when it ends."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
