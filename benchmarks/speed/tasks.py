"""What is measured: tasks, each of which gives some rows of the table."""

from __future__ import annotations

import dataclasses
import functools
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks.speed import baselines, limits, stages
from benchmarks.speed.rows import Baseline, Row, Spread, single, spread_of, time_ms
from hiosdf_jax import datasets
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.field.points import field_of
from hiosdf_jax._src.grid import geometry, lookup, patches
from hiosdf_jax._src.grid.change import Change, Window, place_windows
from hiosdf_jax._src.grid.rays import Beams
from hiosdf_jax._src.mapping import calibration, intake, pipeline
from hiosdf_jax._src.network import training
from hiosdf_jax._src.samples.draw import Samples
from hiosdf_jax._src.state import Field, MapState

Frame = tuple[np.ndarray, np.ndarray]  # cloud (N, 3) m in the sensor's frame, T_world_sensor
Task = Callable[[], list[Row]]

_TURNS = 5

OUT_OF_TIME = "not run: --minutes are over"

_HIOSDF = "import sys; from hiosdf_jax._src.command.cli import main; sys.exit(main(sys.argv[1:]))"

# {label: preset and what is changed of it}, the least memory first: of peaks only the first is a
# configuration's own for sure.
CONFIGS: dict[str, tuple[str, dict[str, Any]]] = {
    "light": ("light", {}),
    "default": ("default", {}),
    "paper, slopes of 1 in 2": ("paper", {"eikonal_every": 2}),
    "paper": ("paper", {}),
}


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        configs: Labels of `CONFIGS`; of the last, the stages are taken apart and maps donated.
        overrides: Fields that are changed in all configurations.
        paper_overrides: Fields that are changed in the paper's training beside PyTorch's.
        frames: Updates that are timed after those that warm up.
        seconds: How long to repeat whatever is repeated.
        processes: How often the imports are timed.
        matrix_edge: Of the product that measures the machine.
        elements: float32 numbers that are changed to measure it, more than a cache holds.
        queries: Points a query asks for.
        baked_queries: The same, of the baked field alone.
        bake_resolution: m.
        cloud_sizes: Points a cloud.
        map_edges: Of square maps as high as the stream's bounds, m.
        endurance: Updates in a row.
        whole_run: Whether to run `hiosdf map` over the whole stream.
    """

    configs: tuple[str, ...]
    overrides: dict[str, Any]
    paper_overrides: dict[str, Any]
    frames: int
    seconds: float
    processes: int
    matrix_edge: int
    elements: int
    queries: int
    baked_queries: int
    bake_resolution: float
    cloud_sizes: tuple[int, ...]
    map_edges: tuple[float, ...]
    endurance: int
    whole_run: bool


FULL = Sizes(
    configs=tuple(CONFIGS),
    overrides={},
    paper_overrides={},
    frames=345,
    seconds=1.0,
    processes=5,
    matrix_edge=8192,
    elements=1 << 28,
    queries=102_400,
    baked_queries=1_048_576,
    bake_resolution=0.05,
    cloud_sizes=(1_000, 16_000, 77_000, 300_000),
    map_edges=(10.0, 20.0, 60.0),
    endurance=10_000,
    whole_run=False,  # needs more packages than a GPU machine may have
)

QUICK = Sizes(
    configs=("light",),
    overrides={},
    paper_overrides={"epochs": 1},
    frames=10,
    seconds=0.3,
    processes=2,
    matrix_edge=1024,
    elements=1 << 26,
    queries=102_400,
    baked_queries=102_400,
    bake_resolution=0.2,
    cloud_sizes=(16_000, 77_000),
    map_edges=(10.0, 20.0),
    endurance=100,
    whole_run=True,
)


@dataclasses.dataclass
class Bench:
    """What the tasks share, and fill in one after another.

    Attributes:
        sizes: How much to measure.
        path: Of the stream.
        frames: Of the stream, read beforehand.
        extent: Its bounds and range.
        deadline: When to stop, on the clock of `time.perf_counter`.
        limits: Of the machine, once they are measured.
        states: The maps that the configurations made of the stream, by label.
        baselines: By the key that rows name.
    """

    sizes: Sizes
    path: Path
    frames: list[Frame]
    extent: datasets.Extent
    deadline: float
    limits: limits.Limits | None = None
    states: dict[str, MapState] = dataclasses.field(default_factory=dict)
    baselines: dict[str, list[Baseline]] = dataclasses.field(default_factory=dict)

    def config(self, label: str, **overrides: Any) -> hio.Config:
        """A configuration of `CONFIGS`, for the stream."""
        preset, changes = CONFIGS[label]
        values = {"max_range": self.extent.max_range} | changes | self.sizes.overrides | overrides
        bounds = values.pop("bounds", self.extent.bounds)
        return getattr(hio.Config, preset)(bounds, **values)

    def frame(self, index: int) -> Frame:
        """A frame; the stream begins again at its end."""
        return self.frames[index % len(self.frames)]

    def out_of_time(self) -> bool:
        """Whether the deadline is past."""
        return time.perf_counter() > self.deadline


def open_bench(path: Path, sizes: Sizes, deadline: float) -> Bench:
    """Reads a stream, an .npz file, so that no reading is timed."""
    stream = datasets.NpzStream(path)
    count = min(len(stream), 200)
    frames = [stream[k] for k in tqdm(range(count), desc="reading", unit="frame")]
    kept = datasets.FrameStream("frames", count, frames.__getitem__)
    return Bench(sizes, path, frames, datasets.find_bounds(kept), deadline)


def plan(bench: Bench) -> Iterator[tuple[str, Task]]:
    """All tasks in their order: their names and what runs them."""
    configs = bench.sizes.configs
    apart = configs[-1]
    if bench.sizes.whole_run:
        yield "hiosdf map", lambda: whole_run_rows(bench)
    yield "imports", lambda: import_rows(bench)
    for label in configs:
        yield f"update, {label}", functools.partial(update_rows, bench, label)
    yield "limits", lambda: limit_rows(bench)
    yield f"stages, {apart}", lambda: stage_rows(bench, apart)
    for label in [label for label in configs[:-1] if not label.startswith("paper")]:
        yield f"training, {label}", functools.partial(training_rows, bench, label)
    yield "training, the paper's", lambda: paper_training_rows(bench)
    yield "network queries", lambda: network_query_rows(bench)
    yield "queries", lambda: query_rows(bench, "default" if "default" in configs else apart)
    yield "compiling by sizes", lambda: compile_sizes(bench)
    yield "donated updates", lambda: donated_rows(bench)
    yield "cloud sizes", lambda: cloud_size_rows(bench)
    yield "map sizes", lambda: map_size_rows(bench)
    yield "endurance", lambda: endurance_rows(bench)


def whole_run_rows(bench: Bench) -> list[Row]:
    """Time and peak memory of `hiosdf map` over the stream, in a process of its own.

    The first of the tasks: a process counts as its own peak what the one that starts it holds.
    """
    with tempfile.TemporaryDirectory() as output:
        command = [sys.executable, "-c", _HIOSDF, "map", str(bench.path), "--output", output]
        start = time.perf_counter()
        process = subprocess.Popen(
            command,
            env=_environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        took_s = time.perf_counter() - start
    if status != 0:
        raise RuntimeError(f"hiosdf map ended with exit code {os.waitstatus_to_exitcode(status)}")
    return [
        Row("hiosdf map, the whole stream, light", "s", single(took_s)),
        Row("resident memory, peak of hiosdf map", "MB", single(_resident_mb(usage))),
    ]


def import_rows(bench: Bench) -> list[Row]:
    """Time to import the package, in processes of their own, beside what it stands on."""
    environment = _environment()

    def seconds(names: str) -> float:
        code = f"import time; t = time.perf_counter(); import {names}; print(time.perf_counter()-t)"
        command = [sys.executable, "-c", code]
        return float(subprocess.check_output(command, env=environment, text=True, timeout=120))

    alone, ours = "jax, flax, optax", "hiosdf_jax"
    seconds(ours)  # files are read and compiled to bytecode once
    pairs = [(seconds(alone), seconds(ours)) for _ in range(bench.sizes.processes)]
    base, own = (spread_of(column) for column in zip(*pairs, strict=True))
    bench.baselines["import"] = [Baseline(f"import {alone}", base)]
    return [Row("import hiosdf_jax", "s", own, compare="import")]


def update_rows(bench: Bench, label: str) -> list[Row]:
    """Whole updates over the stream, the compiled function alone, and what they take."""
    config = bench.config(label)
    state, times_ms, compile_s = _map_frames(bench, config, bench.sizes.frames)
    bench.states[label] = state
    cloud, pose = bench.frame(len(times_ms) + config.warmup_updates)
    prepared = jax.device_put(intake.prepare(cloud, pose, config.max_points))
    alone = time_ms(pipeline._update_jit, state, *prepared, seconds=bench.sizes.seconds)
    arrays = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    resident_mb = _resident_mb(resource.getrusage(resource.RUSAGE_SELF))
    rows = [
        Row(f"update, {label}", "ms", spread_of(times_ms), "training"),
        Row(f"update, {label}, on the device alone", "ms", alone, "training"),
        Row(
            f"compilation of update, {label}",
            "s",
            single(compile_s),
            note="the first update less the second, tracing included",
        ),
        Row(f"arrays of the map, {label}", "MB", single(1e-6 * arrays)),
        Row(f"resident memory, peak so far, {label}", "MB", single(resident_mb)),
    ]
    stats = _device_memory()
    if "peak_bytes_in_use" not in stats:
        return [*rows, Row(f"device memory, {label}", note="this device does not report it")]
    used, peak = (single(1e-6 * stats[key]) for key in ("bytes_in_use", "peak_bytes_in_use"))
    return [
        *rows,
        Row(f"device memory, in use, {label}", "MB", used),
        Row(f"device memory, peak so far, {label}", "MB", peak),
    ]


def limit_rows(bench: Bench) -> list[Row]:
    """The machine's rates, for the shares of the rows that follow."""
    sizes = bench.sizes
    bench.limits, rows = limits.measure(sizes.matrix_edge, sizes.elements, sizes.seconds)
    return rows


def stage_rows(bench: Bench, label: str) -> list[Row]:
    """Each stage by itself; scipy's search and distance transforms beside three of them."""
    config, seconds = bench.config(label), bench.sizes.seconds
    parts = _take_apart(bench, label)
    cloud, valid, *_ = parts["local samples"].arguments
    queries = np.asarray(parts["local samples"].result.points_world)
    cloud, valid = np.asarray(cloud), np.asarray(valid)
    grid, change = parts["distance"].arguments
    searched = _searched(config, change, config.horizon_voxels)
    seen_in = _searched(config, change, config.frontier_voxels)
    window, _, beams = parts["rays"].arguments
    work = {
        "calibration": limits.calibration_work(config, len(cloud), calibration._RETURNS),
        **limits.evidence_work(window.passes.size, len(cloud), _steps(config, beams)),
        "distance": limits.distance_work(config, searched),
        "frontier": limits.frontier_work(config, seen_in),
        "grid samples": limits.grid_samples_work(config),
        "local samples": limits.nearest_work(len(queries), len(cloud)),
        "training": limits.training_work(config),
    }
    compare = {
        "distance": "distance",
        "frontier": "frontier",
        "local samples": "nearest",
        "training": "training",
    }
    rows = []
    for name, part in tqdm(parts.items(), desc=label, leave=False):
        spread = time_ms(part.function, *part.arguments, seconds=seconds)
        rows.append(_row(bench, f"{name}, {label}", spread, work[name], compare.get(name, "")))
    bench.baselines["nearest"] = baselines.nearest(queries, cloud[valid], seconds)
    features, doubtful = _sites(config, grid, searched)
    bench.baselines["distance"] = baselines.distance(features, doubtful, seconds)
    bench.baselines["frontier"] = baselines.frontier(_seen(grid, seen_in), seconds)
    return rows


def training_rows(bench: Bench, label: str) -> list[Row]:
    """The training of a configuration whose stages are not taken apart."""
    config = bench.config(label)
    arguments = _training_arguments(config)
    spread = time_ms(_trainer(config), *arguments, seconds=bench.sizes.seconds)
    return [_row(bench, f"training, {label}", spread, limits.training_work(config), "training")]


def paper_training_rows(bench: Bench) -> list[Row]:
    """The paper's network and schedule, and the same in PyTorch beside it.

    Once more with half of the slopes: PyTorch computes all of them in both cases.
    """
    seconds, rows = bench.sizes.seconds, []
    for every in (1, 2):
        overrides = bench.sizes.paper_overrides | {"eikonal_every": every}
        config = hio.Config.paper(bench.extent.bounds, **overrides)
        arguments = _training_arguments(config)
        network, samples, *_ = arguments
        spread = time_ms(_trainer(config), *arguments, seconds=seconds)
        if every == 1:
            bench.baselines["training"] = baselines.training(config, network, samples, seconds)
        name = f"the paper's training, {config.epochs} epochs of {samples.sdf.size:,}"
        name += "" if every == 1 else f", slopes of 1 in {every}"
        rows.append(_row(bench, name, spread, limits.training_work(config), "training"))
    return rows


def network_query_rows(bench: Bench) -> list[Row]:
    """Distances and gradients by the paper's network alone; its weights do not matter."""
    count, seconds = bench.sizes.queries, bench.sizes.seconds
    config = hio.Config.paper(bench.extent.bounds)
    state = hio.init(config, jax.random.key(0))
    points = _points_in(config, count)
    spread = time_ms(_network, field_of(state), points, seconds=seconds)
    relative = points - state.network.origin_world
    bench.baselines["network query"] = baselines.network_query(
        config, state.network, relative, seconds
    )
    work = limits.network_query_work(config, count)
    name = f"sdf and gradient of {count:,}, the paper's network"
    return [_row(bench, name, spread, work, "network query")]


def query_rows(bench: Bench, label: str) -> list[Row]:
    """Distances and gradients by each way of asking a map of the stream."""
    sizes, seconds = bench.sizes, bench.sizes.seconds
    state = bench.states[label]
    config, field = state.config, hio.snapshot(state)
    points = _points_in(config, sizes.queries)
    rows = []

    def add(name: str, count: int, spread: Spread, work: limits.Work | None = None) -> None:
        full = f"sdf and gradient of {count:,}, {name}, {label}"
        compare = "network query" if count == sizes.queries else ""  # as many as PyTorch's
        rows.append(_row(bench, full, spread, work, compare))

    work = limits.network_query_work(config, sizes.queries)
    add("network", sizes.queries, time_ms(_network, field, points, seconds=seconds), work)
    add("served", sizes.queries, time_ms(hio.sdf_and_grad, field, points, seconds=seconds))
    add("grid", sizes.queries, time_ms(_grid, field, points, seconds=seconds))
    bake = functools.partial(hio.bake, resolution=sizes.bake_resolution)
    baking = time_ms(bake, field, seconds=seconds)
    baked = bake(field)
    samples = f"{baked.sdf.size:,} samples of {sizes.bake_resolution} m"
    for count in dict.fromkeys((sizes.queries, sizes.baked_queries)):
        spread = time_ms(hio.sdf_and_grad, baked, _points_in(config, count), seconds=seconds)
        add("baked", count, spread, limits.baked_work(count))
    return [*rows, Row(f"bake, {label}", "ms", baking, note=samples)]


def compile_sizes(bench: Bench) -> list[Row]:
    """Compiles the updates of the next three tasks, at once on as many cores as there are."""

    def first(config: hio.Config, donate: bool = False) -> Callable[[], MapState]:
        state = hio.init(config, jax.random.key(0))
        return functools.partial(hio.update, state, *bench.frame(0), donate=donate)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        calls = [
            first(bench.config(bench.sizes.configs[-1]), donate=True),
            *_cloud_size_updates(bench).values(),
            *map(first, _map_size_configs(bench).values()),
        ]
        jax.block_until_ready(list(pool.map(lambda call: call(), calls)))
    return []


def donated_rows(bench: Bench) -> list[Row]:
    """Whole updates that take over the memory of the map before, in turns with some that do not."""
    label = bench.sizes.configs[-1]
    config = bench.config(label)
    warmup = max(config.warmup_updates, 1)
    indices = range(warmup, warmup + bench.sizes.frames)
    turns = [range(warmup), *np.array_split(indices, _TURNS)]
    states = {donate: hio.init(config, jax.random.key(0)) for donate in (False, True)}
    times_ms: dict[bool, list[float]] = {donate: [] for donate in states}
    for turn in tqdm(turns, desc="turns", leave=False):
        for donate in states:
            for k in turn:
                states[donate], took_ms = _timed_update(bench, states[donate], k, donate=donate)
                times_ms[donate].append(took_ms)
    kept, donated = (spread_of(times_ms[donate][warmup:]) for donate in states)
    bench.baselines["not donated"] = [Baseline("in turns with it, not donated", kept)]
    return [Row(f"update, {label}, donated", "ms", donated, "not donated")]


def _cloud_size_updates(bench: Bench) -> dict[str, Callable[[], MapState]]:
    rng = np.random.default_rng(0)
    cloud, pose = bench.frame(0)
    cloud = cloud[np.isfinite(cloud).all(axis=-1)]
    updates, base = {}, bench.config("light", warmup_updates=0)
    for count in bench.sizes.cloud_sizes:
        chosen = rng.choice(len(cloud), count, replace=count > len(cloud))
        sized = cloud[chosen] + rng.normal(scale=1e-3, size=(count, 3)).astype(np.float32)
        for how, config in (
            (f"{base.max_points:,} used", base),
            ("all used", dataclasses.replace(base, max_points=count)),
        ):
            state = hio.init(config, jax.random.key(0))
            update = functools.partial(hio.update, state, sized, pose)
            updates[f"update, light, {count:,} points, {how}"] = update
    return updates


def cloud_size_rows(bench: Bench) -> list[Row]:
    """Updates by clouds of several sizes: drawn or padded to one size, and all of them used.

    The first, of the smallest cloud, is the baseline.
    """
    rows, updates = [], _cloud_size_updates(bench)
    first = next(iter(updates))
    for name, update in tqdm(updates.items(), desc="cloud sizes", leave=False):
        if bench.out_of_time():
            return [*rows, Row(name, note=OUT_OF_TIME)]
        spread = time_ms(update, seconds=bench.sizes.seconds)
        if name == first:
            bench.baselines["cloud size"] = [Baseline(name.removeprefix("update, light, "), spread)]
        rows.append(Row(name, "ms", spread, "" if name == first else "cloud size"))
    return rows


def _map_size_configs(bench: Bench) -> dict[str, hio.Config]:
    (_, _, low), (_, _, high) = bench.extent.bounds
    x, y, _ = bench.frame(0)[1][:3, 3].tolist()
    configs = {}
    for edge in bench.sizes.map_edges:
        half = edge / 2
        bounds = ((x - half, y - half, low), (x + half, y + half, high))
        configs[f"a map of {edge:g} m"] = bench.config("light", bounds=bounds, warmup_updates=0)
    return configs


def map_size_rows(bench: Bench) -> list[Row]:
    """Updates of maps of several sizes around one sensor; the smallest is the baseline."""
    rows, configs = [], _map_size_configs(bench)
    first = next(iter(configs))
    for name, config in tqdm(configs.items(), desc="map sizes", leave=False):
        if bench.out_of_time():
            return [*rows, Row(f"update, light, {name}", note=OUT_OF_TIME)]
        state, _, _ = _map_frames(bench, config, 5)
        update = functools.partial(hio.update, state)
        spread = time_ms(update, *bench.frame(5), seconds=bench.sizes.seconds)
        voxels = "x".join(map(str, config.grid_shape))
        if name == first:
            bench.baselines["map size"] = [Baseline(name, spread)]
        key = "" if name == first else "map size"
        rows.append(Row(f"update, light, {name}", "ms", spread, key, note=f"{voxels} voxels"))
        del state
    return rows


def endurance_rows(bench: Bench) -> list[Row]:
    """Updates in a row: whether time, memory or compilations grow."""
    count = bench.sizes.endurance
    state, _, _ = _map_frames(bench, bench.config("light"), 1)
    compilations = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if event.endswith("backend_compile_duration"):
            compilations.append(event)

    def memory() -> dict[str, float]:
        live = sum(array.nbytes for array in jax.live_arrays())
        return {"live arrays": live, "device": _device_memory().get("bytes_in_use", np.nan)}

    before, times_ms = memory(), []
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for k in tqdm(range(count), desc="endurance", unit="update", leave=False):
            state, took_ms = _timed_update(bench, state, k)
            times_ms.append(took_ms)
            if bench.out_of_time():
                break
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    made = len(times_ms)
    tenth = max(1, made // 10)
    start, end = spread_of(times_ms[:tenth]), spread_of(times_ms[-tenth:])
    bench.baselines["endurance"] = [Baseline("their first 10 %", start)]
    flags = hio.Flag(int(state.report.flags))
    cut = f"stopped by --minutes, of {count:,}; " if made < count else ""
    medians = [f"{np.median(part):.2f}" for part in np.array_split(times_ms, min(10, made))]
    note = f"{cut}flags: {flags.name or 'none'}; medians of its tenths: {', '.join(medians)}"
    rows = [
        Row(f"{made:,} updates in a row, light, all", "ms", spread_of(times_ms), note=note),
        Row(f"{made:,} updates in a row, light, last 10 %", "ms", end, "endurance"),
        Row("compilations during these", "", single(len(compilations))),
    ]
    for name, value in memory().items():
        if np.isfinite(value):
            key = f"{name} before"
            bench.baselines[key] = [Baseline(key, single(1e-6 * before[name]))]
            rows.append(Row(f"{name}, bytes after these", "MB", single(1e-6 * value), key))
    return rows


def _map_frames(
    bench: Bench, config: hio.Config, count: int
) -> tuple[MapState, list[float], float]:
    """Maps the warm-up and `count` frames: the map, ms of each of these, s of compilation."""
    state = jax.block_until_ready(hio.init(config, jax.random.key(0)))
    times_ms, warmup = [], max(config.warmup_updates, 1)
    for k in tqdm(range(warmup + count), desc="mapping", unit="frame", leave=False):
        state, took_ms = _timed_update(bench, state, k)
        times_ms.append(took_ms)
    return state, times_ms[warmup:], 1e-3 * (times_ms[0] - times_ms[1])


def _timed_update(
    bench: Bench, state: MapState, index: int, *, donate: bool = False
) -> tuple[MapState, float]:
    """The map with a frame of the stream, and the ms that it took."""
    cloud, pose = bench.frame(index)
    start = time.perf_counter()
    state = jax.block_until_ready(hio.update(state, cloud, pose, donate=donate))
    return state, 1e3 * (time.perf_counter() - start)


def _trainer(config: hio.Config) -> Callable[..., Any]:
    return jax.jit(lambda *arguments: training.train(config, *arguments))


def _training_arguments(config: hio.Config) -> tuple[Any, ...]:
    """An untrained network and distances to a ball: what is learnt does not change the time."""
    network = training.init_network(config, jax.random.key(0))
    count = config.near_samples + config.far_samples
    count += config.local_points * config.local_ray_samples
    points = _points_in(config, count)
    radius = jnp.linalg.norm(points - network.origin_world, axis=-1)
    samples = Samples(points, radius - 1, jnp.ones(count))
    extra_epochs = jnp.int32(config.epochs - training.least_epochs(config))
    return network, samples, extra_epochs, jnp.float32(0.9), jax.random.key(1)


def _take_apart(bench: Bench, label: str) -> dict[str, stages.Stage]:
    state = bench.states[label]
    cloud, pose = bench.frame(int(state.updates))
    prepared = jax.device_put(intake.prepare(cloud, pose, state.config.max_points))
    return stages.take_apart(state, *prepared)


def _sites(config: hio.Config, grid: Any, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """The voxels of the distance transform's window that its two searches look for."""
    start, shape = window.start, window.shape
    hits, passes = (
        geometry.read_window(array, start, shape).astype(jnp.float32)
        for array in (grid.hits, grid.passes)
    )
    axes = geometry.read_window(grid.surface.axes, start, shape)
    features = patches.is_feature(config, hits, passes, axes)
    return np.asarray(features), np.asarray(patches.is_doubtful(hits, passes))


def _seen(grid: Any, window: Window) -> np.ndarray:
    """The voxels of a window that a ray has reached."""
    passes, hits = (
        geometry.read_window(array, window.start, window.shape)
        for array in (grid.passes, grid.hits)
    )
    return np.asarray(lookup.observed(passes, hits))


def _steps(config: hio.Config, beams: Beams) -> float:
    """That are made along the rays; one that ends stops a voxel before and goes on for 3 behind."""
    free = np.asarray(beams.free_ranges)[np.asarray(beams.in_range)] / config.voxel_size
    return float(free.sum()) + 2 * int(np.sum(beams.in_range & beams.ends))


def _searched(config: hio.Config, change: Change, horizon_voxels: int) -> Window:
    """The window in which a change makes a stage compute its distances again."""
    small, large, fits = place_windows(config, change, horizon_voxels * config.voxel_size)
    return small if fits else large


def _row(bench: Bench, name: str, spread: Spread, work: limits.Work | None, compare: str) -> Row:
    if work is None:
        return Row(name, "ms", spread, compare)
    limit, share = limits.share(bench.limits, work, spread.median)
    return Row(name, "ms", spread, compare, limit, share)


def _points_in(config: hio.Config, count: int) -> jax.Array:
    """(count, 3) m, uniform in the bounds."""
    low, high = jnp.asarray(config.bounds, jnp.float32)
    return low + jax.random.uniform(jax.random.key(0), (count, 3)) * (high - low)


def _environment() -> dict[str, str]:
    """For processes that are to import the package that this one has imported."""
    root = Path(hio.__file__).parents[1]
    paths = [str(root), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def _resident_mb(usage: resource.struct_rusage) -> float:
    """The peak; it is given in KiB on Linux and in bytes on macOS."""
    return 1e-6 * usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _device_memory() -> dict[str, int]:
    return jax.devices()[0].memory_stats() or {}


_network = jax.jit(blend.network_sdf_and_grad)


@jax.jit
def _grid(field: Field, points_world: jax.Array) -> tuple[jax.Array, jax.Array]:
    return lookup.grid_sdf_and_grad(field.config, field.surface, points_world)
