"""Tasks that time distances and gradients by each variant of a map."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

import hiosdf_jax as hio
from benchmarks.speed import limits
from benchmarks.speed.rows import Baseline, Measured, Row, Spread, time_ms
from benchmarks.speed.setup import Sizes
from benchmarks.variants import VARIANTS
from hiosdf_jax._src.command.timing import points_in
from hiosdf_jax._src.state.pytrees import MapState


def query_map(label: str, state: MapState, machine: limits.Limits, sizes: Sizes) -> Measured:
    """Times the network alone, both blended, the grid alone, and a baked field.

    Args:
        label: Name of the configuration.
        state: A map of the stream.
        machine: The machine's rates.
        sizes: Points per query, resolution of the baked field, and how long to time each.

    Returns:
        Rows in ms; those of as many points as PyTorch's queries stand beside them.
    """
    config, field, rows = state.config, hio.snapshot(state), []

    def add(name: str, count: int, spread: Spread, work: limits.Work | None = None) -> None:
        full = f"sdf and gradient of {count:,}, {name}, {label}"
        compare = "network query" if count == sizes.queries else ""
        rows.append(limits.row(machine, full, spread, work, compare))

    points = points_in(config, sizes.queries)
    work = limits.network_query_work(config, sizes.queries)
    time = functools.partial(time_ms, seconds=sizes.seconds)
    add("network", sizes.queries, time(VARIANTS["network"], field, points), work)
    add("blended", sizes.queries, time(VARIANTS["blended"], field, points))
    add("grid", sizes.queries, time(VARIANTS["grid"], field, points))
    bake = functools.partial(hio.bake, resolution=sizes.bake_resolution)
    baking = time(bake, field)
    baked = bake(field)
    for count in dict.fromkeys((sizes.queries, sizes.baked_queries)):
        add("baked", count, time(hio.sdf_and_grad, baked, points_in(config, count)))
    samples = f"{baked.sdf.size:,} samples of {sizes.bake_resolution} m"
    return Measured([*rows, Row(f"bake, {label}", "ms", baking, note=samples)])


def query_points_one_by_one(label: str, field: hio.Field, sizes: Sizes) -> Measured:
    """Times functions of one point under `jax.vmap` beside the same points as one batch.

    Args:
        label: Name of the configuration.
        field: A snapshot of a map.
        sizes: Points per query, and how long to time each.

    Returns:
        Rows in ms, with the peak of the temporary memory as a note, and the batches as baselines.
    """
    rows, baselines = [], {}
    functions = {
        "sdf": (hio.sdf, hio.sdf),
        "value_and_grad(sdf)": (jax.value_and_grad(hio.sdf, argnums=1), hio.sdf_and_grad),
    }
    for count in dict.fromkeys((sizes.queries, sizes.baked_queries)):
        points = points_in(field.config, count)
        for name, (one_point, batch) in functions.items():
            full = f"vmap({name}) of {count:,}, {label}"
            vmapped = jax.vmap(one_point, in_axes=(None, 0))
            spread, note = _time_with_memory(vmapped, field, points, sizes.seconds)
            beside, beside_note = _time_with_memory(batch, field, points, sizes.seconds)
            rows.append(Row(full, "ms", spread, full, note=note))
            baselines[full] = [Baseline(f"one batch, {beside_note}", beside)]
    return Measured(rows, baselines)


def _time_with_memory(
    function: Callable[..., Any], field: hio.Field, points: jax.Array, seconds: float
) -> tuple[Spread, str]:
    """Times a compiled function; the note is the memory of its temporary arrays."""
    compiled = jax.jit(function).lower(field, points).compile()
    analysis = compiled.memory_analysis()
    note = f"{1e-6 * analysis.temp_size_in_bytes:.0f} MB" if analysis else "memory unknown"
    return time_ms(compiled, field, points, seconds=seconds), note
