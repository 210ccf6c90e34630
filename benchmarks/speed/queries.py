"""Task that times distances and gradients by each variant of a map."""

from __future__ import annotations

import functools

import hiosdf_jax as hio
from benchmarks.speed import limits
from benchmarks.speed.networks import points_in
from benchmarks.speed.rows import Measured, Row, Spread, time_ms
from benchmarks.speed.setup import Sizes
from benchmarks.variants import VARIANTS
from hiosdf_jax._src.state import MapState


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
