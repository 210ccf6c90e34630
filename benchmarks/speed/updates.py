"""Tasks that time whole updates over the stream, and the memory they take."""

from __future__ import annotations

import resource
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks.speed.processes import resident_mb
from benchmarks.speed.rows import Baseline, Measured, Row, single, spread_of, time_ms
from benchmarks.speed.setup import Setup
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.state.pytrees import MapState

_TURNS = 5


class Mapped(NamedTuple):
    """A map of the stream's first frames.

    Attributes:
        state: The map.
        times_ms: Times of the updates after those that warm up.
        compile_s: The first update less the second.
    """

    state: MapState
    times_ms: list[float]
    compile_s: float


def map_frames(setup: Setup, config: hio.Config, count: int) -> Mapped:
    """Maps the frames that warm up and `count` more."""
    state = jax.block_until_ready(hio.init(config, jax.random.key(0)))
    times_ms, warmup = [], max(config.warmup_updates, 1)
    for k in tqdm(range(warmup + count), desc="mapping", unit="frame", leave=False):
        state, took_ms = _timed_update(setup, state, k)
        times_ms.append(took_ms)
    return Mapped(state, times_ms[warmup:], 1e-3 * (times_ms[0] - times_ms[1]))


def whole_updates(setup: Setup, label: str, mapped: Mapped) -> Measured:
    """Describes whole updates, the compiled function alone, and their memory.

    Args:
        setup: The run's setup.
        label: Name of the configuration.
        mapped: The map that the updates made.

    Returns:
        Rows in ms, s and MB.
    """
    state = mapped.state
    cloud, pose = setup.frame(int(state.updates))
    prepared = jax.device_put(pipeline.check_and_pad(cloud, pose, state.config.max_points))
    alone = time_ms(
        pipeline._update_jit,
        state,
        *prepared,
        None,
        None,
        np.uint32(0),
        seconds=setup.sizes.seconds,
    )
    arrays = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    resident = resident_mb(resource.getrusage(resource.RUSAGE_SELF))
    rows = [
        Row(f"update, {label}", "ms", spread_of(mapped.times_ms), "training"),
        Row(f"update, {label}, on the device alone", "ms", alone, "training"),
        Row(
            f"compilation of update, {label}",
            "s",
            single(mapped.compile_s),
            note="the first update less the second, tracing included",
        ),
        Row(f"arrays of the map, {label}", "MB", single(1e-6 * arrays)),
        Row(f"resident memory, peak so far, {label}", "MB", single(resident)),
    ]
    stats = _device_memory()
    if "peak_bytes_in_use" not in stats:
        rows.append(Row(f"device memory, {label}", note="this device does not report it"))
        return Measured(rows)
    used, peak = (single(1e-6 * stats[key]) for key in ("bytes_in_use", "peak_bytes_in_use"))
    rows.append(Row(f"device memory, in use, {label}", "MB", used))
    rows.append(Row(f"device memory, peak so far, {label}", "MB", peak))
    return Measured(rows)


def donated_updates(setup: Setup, label: str) -> Measured:
    """Times updates that take over the old map's memory, in turns with updates that do not.

    Args:
        setup: The run's setup.
        label: Name of the configuration.

    Returns:
        A row in ms, and the updates that do not as its baseline.
    """
    config = setup.config(label)
    warmup = max(config.warmup_updates, 1)
    indices = range(warmup, warmup + setup.sizes.frames)
    turns = [range(warmup), *np.array_split(indices, _TURNS)]
    states = {donate: hio.init(config, jax.random.key(0)) for donate in (False, True)}
    times_ms: dict[bool, list[float]] = {donate: [] for donate in states}
    for turn in tqdm(turns, desc="turns", leave=False):
        for donate in states:
            for k in turn:
                states[donate], took_ms = _timed_update(setup, states[donate], k, donate=donate)
                times_ms[donate].append(took_ms)
    kept, donated = (spread_of(times_ms[donate][warmup:]) for donate in states)
    row = Row(f"update, {label}, donated", "ms", donated, "not donated")
    return Measured([row], {"not donated": [Baseline("in turns with it, not donated", kept)]})


def endurance(setup: Setup) -> Measured:
    """Makes many updates in a row, to see whether time, memory or compilations grow."""
    count = setup.sizes.endurance
    state = map_frames(setup, setup.config("light"), 1).state
    compilations = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if event.endswith("backend_compile_duration"):
            compilations.append(event)

    before, times_ms = _memory(), []
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for k in tqdm(range(count), desc="endurance", unit="update", leave=False):
            state, took_ms = _timed_update(setup, state, k)
            times_ms.append(took_ms)
            if setup.is_over():
                break
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    made = len(times_ms)
    tenth = max(1, made // 10)
    start, end = spread_of(times_ms[:tenth]), spread_of(times_ms[-tenth:])
    flags = hio.Flag(state.report.flags)
    cut = f"stopped by --minutes, of {count:,}; " if made < count else ""
    medians = [f"{np.median(part):.2f}" for part in np.array_split(times_ms, min(10, made))]
    note = f"{cut}flags: {flags.name or 'none'}; medians of its tenths: {', '.join(medians)}"
    rows = [
        Row(f"{made:,} updates in a row, light, all", "ms", spread_of(times_ms), note=note),
        Row(f"{made:,} updates in a row, light, last 10 %", "ms", end, "endurance"),
        Row("compilations during these", "", single(len(compilations))),
    ]
    baselines = {"endurance": [Baseline("their first 10 %", start)]}
    for name, value in _memory().items():
        if np.isfinite(value):
            key = f"{name} before"
            baselines[key] = [Baseline(key, single(1e-6 * before[name]))]
            rows.append(Row(f"{name}, bytes after these", "MB", single(1e-6 * value), key))
    return Measured(rows, baselines)


def _timed_update(
    setup: Setup, state: MapState, index: int, *, donate: bool = False
) -> tuple[MapState, float]:
    """The map with a frame of the stream, and the ms that the update took."""
    cloud, pose = setup.frame(index)
    start = time.perf_counter()
    state = jax.block_until_ready(hio.update(state, cloud, pose, donate=donate))
    return state, 1e3 * (time.perf_counter() - start)


def _memory() -> dict[str, float]:
    """Bytes in use."""
    live = sum(array.nbytes for array in jax.live_arrays())
    return {"live arrays": live, "device": _device_memory().get("bytes_in_use", np.nan)}


def _device_memory() -> dict[str, int]:
    return jax.devices()[0].memory_stats() or {}
