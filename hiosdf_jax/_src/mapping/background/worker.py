"""A child process that keeps a map and fuses frames into it: the child's side."""

from __future__ import annotations

import os
import pickle
import threading
import time
import traceback
import warnings
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import jax

from hiosdf_jax._src.mapping.background import child
from hiosdf_jax._src.mapping.background.child import Answer, Warned, to_device, to_host
from hiosdf_jax._src.mapping.background.serving import Frame, Fuser, RefusedError

_LOOK_FOR_PARENT_S = 0.5


def work(connection: Connection) -> NoReturn:
    """Answers the requests of `child.Child` until the parent ends or an exception is raised.

    Args:
        connection: The socket to the parent, from which `sys.path` was read.
    """
    child.inside = True
    # An end that waits for nothing, also while XLA compiles.
    threading.Thread(target=_end_with, args=[os.getppid()], daemon=True).start()
    try:
        settings, state = connection.recv()
        for name, value in settings.items():
            jax.config.update(name, value)
        fuser = Fuser(to_device(state))
        answer = Answer()
        while answer.raised is None:
            answer = _answer(fuser, *connection.recv())
            connection.send_bytes(_packed(answer))
    except (EOFError, OSError):  # the parent has ended
        pass
    os._exit(0)


def _answer(fuser: Fuser, request: str, *arguments: Any) -> Answer:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # the parent's filters decide
        refused = raised = result = None
        try:
            result = to_host(fuser.fetch() if request == "fetch" else _fuse(fuser, *arguments))
        except RefusedError as error:
            refused = _portable(error.reason)
        except BaseException as error:
            raised = _portable(error)
    warned = [Warned(str(w.message), _known(w.category), w.filename, w.lineno) for w in caught]
    return Answer(result, refused, raised, tuple(warned))


def _fuse(fuser: Fuser, frame: Frame, packed_serve: bytes) -> Any:
    def serve(field: Any) -> Any:
        function = pickle.loads(packed_serve)  # here, where a failure refuses the frame alone
        return field if function is None else function(field)

    return fuser.fuse(frame, serve)


def _packed(answer: Answer) -> bytes:
    """Pickles an answer; of a result that cannot be, such as a lock, only the reason."""
    try:
        return pickle.dumps(answer)
    except Exception as error:
        reason = ValueError(f"serve returned what cannot leave the mapping process: {error}")
        return pickle.dumps(Answer(refused=reason))


def _known(category: type[Warning]) -> type[Warning]:
    """Returns the nearest class of a warning that the parent can import."""
    for kind in category.__mro__:
        try:
            pickle.dumps(kind)
        except Exception:  # a class inside a function
            continue
        return kind
    return Warning


def _portable(error: Any) -> Any:
    """Returns an exception that the parent can read, with the place where it was raised."""
    error.add_note("in the mapping process:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with(parent: int) -> NoReturn:
    """Ends this process once its parent has ended; another process then is its parent."""
    while os.getppid() == parent:
        time.sleep(_LOOK_FOR_PARENT_S)
    os._exit(1)
