"""Times of calls, and what they were measured on; the benchmarks use it too."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.config import Config


def time_calls(
    function: Callable[..., Any],
    *arguments: Any,
    seconds: float,
    block: Callable[[Any], Any] = jax.block_until_ready,
) -> list[float]:
    """Times a function after two calls that warm up.

    Args:
        function: The function.
        *arguments: Its arguments.
        seconds: How long to repeat it; it is called 5 to 300 times.
        block: Waits until a result is there.

    Returns:
        The time of each call, ms.
    """
    for _ in range(2):
        block(function(*arguments))
    times_ms, end = [], time.perf_counter() + seconds
    while len(times_ms) < 5 or (len(times_ms) < 300 and time.perf_counter() < end):
        start = time.perf_counter()
        block(function(*arguments))
        times_ms.append(1e3 * (time.perf_counter() - start))
    return times_ms


def points_in(config: Config, count: int) -> jax.Array:
    """Draws points uniformly in the bounds, (count, 3) m."""
    low, high = jnp.asarray(config.bounds, jnp.float32)
    return low + jax.random.uniform(jax.random.key(0), (count, 3)) * (high - low)


def host_name() -> str:
    """Names the host's processor and counts its cores."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text("utf-8").splitlines() if known.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{[*models, platform.processor()][0]}, {os.cpu_count()} cores"


def format_number(value: float) -> str:
    """Writes a number with three significant digits, or more before the point."""
    if not math.isfinite(value):
        return str(value)
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:,.{min(digits, 6)}f}"
