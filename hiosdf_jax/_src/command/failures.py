"""What ends the command: one line on stderr, and an exit code."""

from __future__ import annotations

import os
from collections.abc import Callable

NOTHING_MAPPED, BAD_INPUT = 1, 2
"""Exit codes; argparse itself exits with 2."""

SKIP_HINT = " (--skip-bad-frames skips such frames)"


class Failure(Exception):
    """Ends the command with one line on stderr and an exit code."""

    def __init__(self, message: object, code: int) -> None:
        super().__init__(message)
        self.code = code


def checked[Result](call: Callable[[], Result], code: int = BAD_INPUT) -> Result:
    """Calls a function, and turns its errors into a failure with a message of one line."""
    from hiosdf_jax._src.datasets.stream import BadFrameError

    try:
        return call()
    except BadFrameError as error:
        raise Failure(f"{error}{SKIP_HINT}", BAD_INPUT) from error
    except (OSError, ValueError, ModuleNotFoundError) as error:
        raise Failure(message_of(error), code) from error


def message_of(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fspath(error.filename)}: {error.strerror}"
    return " ".join(str(error).split())
