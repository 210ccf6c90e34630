"""The tasks of a run. Each measures by itself; what several need is made once, by the first."""

from __future__ import annotations

import functools
from collections.abc import Callable

import hiosdf_jax as hio
from benchmarks.speed import (
    fleets,
    limits,
    meshes,
    networks,
    processes,
    queries,
    scaling,
    stages,
    updates,
)
from benchmarks.speed.rows import Measured
from benchmarks.speed.setup import Setup
from hiosdf_jax._src.state.pytrees import MapState

Task = Callable[[], Measured]


def make_plan(setup: Setup) -> dict[str, Task]:
    """Lists the tasks of a run.

    Args:
        setup: The run's setup.

    Returns:
        The tasks by name, in the order in which peaks of memory mean most.
    """
    sizes = setup.sizes
    seconds, bounds, last = sizes.seconds, setup.extent.bounds, sizes.configs[-1]

    @functools.cache
    def measured() -> tuple[limits.Limits, Measured]:
        return limits.measure(sizes.matrix_edge, sizes.elements, seconds)

    @functools.cache
    def mapped(label: str) -> updates.Mapped:
        return updates.map_frames(setup, setup.config(label), sizes.frames)

    def machine() -> limits.Limits:
        return measured()[0]

    def state(label: str) -> MapState:
        return mapped(label).state

    def train(label: str) -> Measured:
        return networks.train(label, setup.config(label), machine(), seconds)

    def time_stages(label: str) -> Measured:
        frame = setup.frame(int(state(label).updates))
        parts = stages.take_apart(state(label), frame)
        return stages.time_parts(label, parts, machine(), seconds)

    tasks: dict[str, Task] = {}
    if sizes.whole_run:
        tasks["hiosdf map"] = lambda: processes.run_command(setup.path)
    tasks["imports"] = lambda: processes.import_package(sizes.processes)
    for label in sizes.configs:
        tasks[f"update, {label}"] = lambda label=label: updates.whole_updates(
            setup, label, mapped(label)
        )
    tasks["limits"] = lambda: measured()[1]
    tasks[f"stages, {last}"] = lambda: time_stages(last)
    for label in sizes.configs[:-1]:
        if not label.startswith("paper"):
            tasks[f"training, {label}"] = functools.partial(train, label)
    tasks["training, the paper's"] = lambda: networks.train_paper(
        bounds, sizes.paper_overrides, machine(), seconds
    )
    tasks["network queries"] = lambda: networks.query_paper(
        bounds, sizes.queries, machine(), seconds
    )
    queried = "default" if "default" in sizes.configs else last
    tasks["queries"] = lambda: queries.query_map(queried, state(queried), machine(), sizes)
    tasks["points one by one"] = lambda: queries.query_points_one_by_one(
        queried, hio.snapshot(state(queried)), sizes
    )
    if sizes.whole_run:
        tasks["meshes"] = lambda: meshes.extract_meshes(setup, last)
    tasks["fleet"] = lambda: fleets.maps_at_once(sizes.fleet, seconds)
    tasks["compiling by sizes"] = lambda: scaling.compile_updates(setup, last)
    tasks["donated updates"] = lambda: updates.donated_updates(setup, last)
    tasks["cloud sizes"] = lambda: scaling.cloud_sizes(setup)
    tasks["map sizes"] = lambda: scaling.map_sizes(setup)
    tasks["endurance"] = lambda: updates.endurance(setup)
    return tasks
