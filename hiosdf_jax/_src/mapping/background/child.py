"""A child process that keeps a map and fuses frames into it: the parent's side.

The two sides exchange pickled tuples over a socket that nobody else can open. The first messages
are `sys.path`, which the child needs before it can import this package, and the map with the
settings of JAX that its numbers depend on. Then the child answers one request after the other;
`worker` has its side.
"""

from __future__ import annotations

import functools
import os
import pickle
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable
from multiprocessing.connection import Pipe
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.mapping.background.serving import Frame, Published, RefusedError, Serve
from hiosdf_jax._src.state.pytrees import MapState

# The kernel prefers every other process from the first import on: threads keep the priority that
# they were started with. A controller in real time would pass its own on.
_START = """
import os, signal, sys
if hasattr(os, "SCHED_OTHER") and os.sched_getscheduler(0) != os.SCHED_OTHER:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
os.setpriority(os.PRIO_PROCESS, 0, 19)
signal.signal(signal.SIGINT, signal.SIG_IGN)
from multiprocessing.connection import Connection
connection = Connection(int(sys.argv[1]))
sys.path[:] = connection.recv()
from hiosdf_jax._src.mapping.background import worker
worker.work(connection)
"""

_SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
    "jax_default_matmul_precision",
    "jax_enable_x64",
    "jax_threefry_partitionable",
)
"""Settings of JAX that the child takes from its parent."""

_ENDING_S = 2.0  # from the loss of the connection to the exit

inside = False
"""Whether this process is such a child: it starts none itself."""


class Warned(NamedTuple):
    """A warning of the child's, to be shown by the parent."""

    message: str
    category: type[Warning]
    filename: str
    lineno: int


class Answer(NamedTuple):
    """What the child says to a request.

    Attributes:
        result: What was asked for, on the host; None after an exception.
        refused: Why a frame was refused, or None.
        raised: The exception that ends the child, or None.
        warned: Warnings on the way.
    """

    result: Any = None
    refused: Exception | None = None
    raised: BaseException | None = None
    warned: tuple[Warned, ...] = ()


class _Key(NamedTuple):
    """A typed key of JAX, on the host."""

    data: np.ndarray
    impl: str


class Child:
    """A `Fuser` in a child process, on the CPU, with the least priority.

    Attributes:
        state: The map; None while the child's is newer.
        fault: How the process has ended, or None.
    """

    def __init__(self, state: MapState, on_end: Callable[[], object]) -> None:
        """Starts the process.

        Args:
            state: The map.
            on_end: Called from another thread when the process has ended.

        Raises:
            RuntimeError: This is such a process itself, or the interpreter is not known.
            OSError: No process can be started.
        """
        if inside:
            raise RuntimeError("a mapping process cannot start another one")
        if not sys.executable:
            raise RuntimeError("sys.executable is empty, expected the path of Python")
        self.state: MapState | None = state
        self.fault: RuntimeError | None = None
        self._first: MapState | None = state
        self._shown: dict[Any, Any] = {}
        self._owner = os.getpid()
        self._connection, theirs = Pipe()
        with theirs:
            number = theirs.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _START, str(number)],
                stdin=subprocess.DEVNULL,
                pass_fds=[number],
                # Ctrl-C in a terminal is for the parent. The session stays the same: the kernel may
                # share the processor among sessions before it looks at niceness.
                process_group=0,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},
            )
        threading.Thread(
            target=self._watch, args=[on_end], name="hiosdf_jax child", daemon=True
        ).start()

    def fuse(self, frame: Frame, serve: Serve) -> Published:
        """Fuses a frame as `Fuser` does.

        Raises:
            RefusedError: The frame or its field is bad.
            RuntimeError: The process has ended.
            Exception: Anything else that the child raised.
        """
        try:
            packed_serve = pack_serve(serve)
        except ValueError as reason:  # its arguments have changed since it was set
            raise RefusedError(reason) from reason
        result = self._ask("fuse", to_host(frame), packed_serve)
        return Published(to_device(result.field), result.stamp)

    def fetch(self) -> MapState:
        """Returns the map, and keeps it until the next frame."""
        if self.state is None:
            self.state = to_device(self._ask("fetch"))
        return self.state

    def stop(self) -> None:
        """Kills the process; without effect in a fork of its parent."""
        if os.getpid() == self._owner:
            self._process.kill()
            self._process.wait()

    def _ask(self, *request: Any) -> Any:
        try:
            if self._first is not None:
                settings = {name: getattr(jax.config, name) for name in _SETTINGS}
                self._connection.send([str(entry) for entry in sys.path])
                self._connection.send((settings, to_host(self._first)))
                self._first = None
            self.state = None if request[0] == "fuse" else self.state
            self._connection.send(request)
            packed_answer = self._connection.recv_bytes()
        except (EOFError, OSError) as error:
            self._end()
            raise self._how_it_ended() from error
        try:
            answer: Answer = pickle.loads(packed_answer)
        except Exception as reason:  # whatever an object of the user's raises
            raise RefusedError(reason) from reason
        if answer.raised is not None:
            raise answer.raised
        try:
            for warned in answer.warned:
                warnings.warn_explicit(*warned, registry=self._shown)
        except Warning as reason:  # where the user has made it an error
            raise RefusedError(reason) from reason
        if answer.refused is not None:
            raise RefusedError(answer.refused) from answer.refused
        return answer.result

    def _end(self) -> None:
        """Waits for the end of a process whose connection is gone, or kills it."""
        try:
            self._process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            self.stop()

    def _how_it_ended(self) -> RuntimeError:
        code = self._process.wait()
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return RuntimeError(f"the mapping process {how}")

    def _watch(self, on_end: Callable[[], object]) -> None:
        self._process.wait()
        self.fault = self._how_it_ended()
        on_end()


def pack_serve(serve: Any) -> bytes:
    """Pickles a function for the child.

    Args:
        serve: A function that the child can import, `functools.partial` of one, or None.

    Returns:
        The name of the function and the arguments of the partial.

    Raises:
        ValueError: It is something else. What is pickled is a copy: a closure or an object's method
            would keep the values that it has now.
    """
    function = serve.func if isinstance(serve, functools.partial) else serve
    if function is not None and not _is_importable(function):
        raise ValueError(
            f"serve is {serve!r}, expected a function that a process can import: one at the top of "
            "a module other than the script that runs, or functools.partial of one, such as "
            "functools.partial(hio.bake, resolution=0.1)"
        )
    try:
        return pickle.dumps(serve)
    except Exception as error:  # whatever an object of the user's raises
        raise ValueError(f"serve has arguments that a process cannot take: {error}") from error


def _is_importable(function: Any) -> bool:
    """Whether a name in a module leads to a function."""
    name = getattr(function, "__module__", None)
    found: Any = sys.modules.get(name) if isinstance(name, str) and name != "__main__" else None
    for part in getattr(function, "__qualname__", "").split("."):
        found = getattr(found, part, None)
    return found is not None and found is function


def to_host(tree: Any) -> Any:
    """Turns arrays of JAX into what pickle can write."""

    def leaf(value: Any) -> Any:
        if not isinstance(value, jax.Array):
            return value
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            data = np.asarray(jax.device_get(jax.random.key_data(value)))
            return _Key(data, str(jax.random.key_impl(value)))
        return np.asarray(jax.device_get(value))

    return jax.tree.map(leaf, tree)


def to_device(tree: Any) -> Any:
    """Turns what `to_host` made back into arrays of JAX."""

    def leaf(value: Any) -> Any:
        if isinstance(value, _Key):
            return jax.random.wrap_key_data(jax.device_put(value.data), impl=value.impl)
        return jax.device_put(value) if isinstance(value, np.ndarray) else value

    return jax.tree.map(leaf, tree, is_leaf=lambda value: isinstance(value, _Key))
