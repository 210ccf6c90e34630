"""Shared compilations and maps: most of the time of these tests is spent in XLA's compiler."""

import gc
import os
import signal
from pathlib import Path

import jax
import pytest

# The same folder for both workers, for the commands that tests start, and for the next run.
# `pytest --cache-clear` empties it.
_cache = os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "d" / "jax")
)
jax.config.update("jax_compilation_cache_dir", _cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # thousands are small

# Half of the time of tracing is garbage collection otherwise.
gc.set_threshold(100_000, 50, 100)

from room import CONFIG, map_of_room

import hiosdf_jax as hio

# Each compiled function takes some memory maps. The kernel allows a process 65,530 of them, and
# XLA crashes without more.
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 40_000


@pytest.fixture(autouse=True)
def signals_of_a_terminal():
    """Restores signals that `nohup` or a shell's `&` ignores: commands leave those ignored."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    ignored = [number for number in usual if signal.getsignal(number) == signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, usual[number])
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(autouse=True, scope="module")
def few_memory_maps():
    """Forgets compiled functions after a module that has left too many memory maps."""
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def empty_map():
    """A map of the room without updates."""
    return hio.init(CONFIG, jax.random.key(0))


@pytest.fixture(scope="session")
def room_map():
    """A small map of the room after four frames."""
    return map_of_room(CONFIG, jax.random.key(0))


@pytest.fixture(scope="session")
def sharp_map():
    """The same map after many frames; by then it has learned the room."""
    return map_of_room(CONFIG, jax.random.key(0), 48, 300)
