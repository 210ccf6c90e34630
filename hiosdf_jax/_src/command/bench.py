"""How fast a map is on this machine: `hiosdf bench`."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.command.timing import format_number, host_name, points_in, time_calls
from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.stream import Stream
from hiosdf_jax._src.field import baking
from hiosdf_jax._src.field.queries import sdf_and_grad
from hiosdf_jax._src.mapping import lifecycle, pipeline
from hiosdf_jax._src.scoring.table import lay_out

FRAMES = 20
"""Frames of the demo that `hiosdf bench` maps."""

_QUERIES = 102_400  # as in the benchmarks
_RESOLUTION_M = 0.1
_SECONDS = 2.0  # to repeat each query


def measure(
    stream: Stream,
    config: Config,
    *,
    queries: int = _QUERIES,
    resolution: float = _RESOLUTION_M,
    seconds: float = _SECONDS,
) -> dict[str, Any]:
    """Maps a stream and queries the map; each call is timed until its result is there.

    A progress bar shows how far it has come. The frames are read before anything is timed.

    Args:
        stream: The frames; at least one more than the updates that warm up.
        config: The map's configuration.
        queries: Points per query.
        resolution: Spacing of the baked field's samples, m.
        seconds: How long to repeat each query.

    Returns:
        The record: the device, the host, versions, and `rows` of name, unit and value, with 10 %
        and 90 % quantiles for what was repeated.
    """
    from tqdm import tqdm

    bar = tqdm(total=2 * len(stream) + 2, desc="rendering", leave=False)

    def step(then: str) -> None:
        bar.update()
        bar.set_description(then)

    frames = []
    for k in range(len(stream)):
        frames.append(stream[k])
        step("rendering" if k + 1 < len(stream) else "first update")
    state = jax.block_until_ready(lifecycle.init(config, jax.random.key(0)))
    updates_s = []
    for cloud, pose in frames:
        start = time.perf_counter()
        state = jax.block_until_ready(pipeline.update(state, cloud, pose))
        updates_s.append(time.perf_counter() - start)
        step("updates")
    updates_s = np.array(updates_s)
    later_ms = 1e3 * updates_s[max(config.warmup_updates, 1) :]  # the first ones train longer
    field, where = lifecycle.snapshot(state), points_in(config, queries)
    bar.set_description("distances")
    queries_ms = time_calls(sdf_and_grad, field, where, seconds=seconds)
    step("baking")
    baking_ms = time_calls(baking.bake, field, resolution, seconds=seconds / 4)
    step("baked distances")
    baked = baking.bake(field, resolution)
    baked_ms = time_calls(sdf_and_grad, baked, where, seconds=seconds)
    bar.close()

    memory_mb = 1e-6 * sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    asked = f"{queries:,} distances with gradient"
    rows = [
        {"name": "first update", "unit": "s", "value": float(updates_s[0])},
        {"name": "updates per second", "unit": "1/s", "value": 1e3 / float(np.median(later_ms))},
        _repeated("an update", later_ms),
        _repeated(asked, queries_ms),
        _repeated(f"bake at {100 * resolution:g} cm", baking_ms),
        _repeated(f"{asked}, baked", baked_ms),
        {"name": "arrays of the map", "unit": "MB", "value": memory_mb},
    ]
    return {
        "device": jax.devices()[0].device_kind,
        "host": host_name(),
        "jax": jax.__version__,
        "compilation_cache": bool(jax.config.jax_compilation_cache_dir),
        "voxels": list(config.grid_shape),
        "updates": int(state.updates),
        "config": dataclasses.asdict(config),
        "rows": rows,
    }


def _repeated(name: str, times_ms: Any) -> dict[str, Any]:
    low, median, high = np.percentile(times_ms, (10, 50, 90)).tolist()
    return {"name": name, "unit": "ms", "value": median, "p10": low, "p90": high}


def format_record(record: dict[str, Any]) -> str:
    """Formats what `measure` returns for a terminal.

    Args:
        record: The figures.

    Returns:
        A table, and lines that say what it was measured on.
    """
    cells = [["", "unit", "value", "10 % below", "90 % below"]]
    for row in record["rows"]:
        values = [row.get(key) for key in ("value", "p10", "p90")]
        numbers = ["" if each is None else format_number(each) for each in values]
        cells.append([row["name"], row["unit"], *numbers])
    voxels = " x ".join(map(str, record["voxels"]))
    cached = "compiles; with JAX_COMPILATION_CACHE_DIR set, later runs read the result"
    if record["compilation_cache"]:
        cached = "compiles, or reads JAX's compilation cache"
    return "\n".join(
        [
            lay_out(cells, text_columns=2),
            "",
            f"device {record['device']}, host {record['host']}, jax {record['jax']}",
            f"map of {voxels} voxels; first update: {cached}",
        ]
    )
