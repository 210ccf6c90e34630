"""Tasks that time updates by the size of the cloud and of the map."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from tqdm import tqdm

import hiosdf_jax as hio
from benchmarks.speed.rows import OUT_OF_TIME, Baseline, Measured, Row, time_ms
from benchmarks.speed.setup import Setup
from benchmarks.speed.updates import map_frames
from hiosdf_jax._src.state.pytrees import MapState


def compile_updates(setup: Setup, donated: str) -> Measured:
    """Compiles the updates of the tasks below and the donated ones, at once on all cores.

    Args:
        setup: The run's setup.
        donated: Name of the configuration whose maps are donated.

    Returns:
        No rows; the tasks find their updates compiled.
    """

    def first(config: hio.Config, donate: bool = False) -> Callable[[], MapState]:
        state = hio.init(config, jax.random.key(0))
        return functools.partial(hio.update, state, *setup.frame(0), donate=donate)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        calls = [
            first(setup.config(donated), donate=True),
            *_cloud_size_updates(setup).values(),
            *map(first, _map_size_configs(setup).values()),
        ]
        jax.block_until_ready(list(pool.map(lambda call: call(), calls)))
    return Measured([])


def cloud_sizes(setup: Setup) -> Measured:
    """Times updates by the size of the cloud, drawn or padded to one size, and used as a whole.

    The first row, of the smallest cloud, is the baseline.
    """
    rows, baseline, updates = [], {}, _cloud_size_updates(setup)
    for name, update in tqdm(updates.items(), desc="cloud sizes", leave=False):
        if setup.is_over():
            rows.append(Row(name, note=OUT_OF_TIME))
            break
        spread = time_ms(update, seconds=setup.sizes.seconds)
        rows.append(Row(name, "ms", spread, "cloud size" if baseline else ""))
        shown = name.removeprefix("update, light, ")
        baseline = baseline or {"cloud size": [Baseline(shown, spread)]}
    return Measured(rows, baseline)


def map_sizes(setup: Setup) -> Measured:
    """Times updates by the size of the map around one sensor; the smallest is the baseline."""
    rows, baseline, configs = [], {}, _map_size_configs(setup)
    for name, config in tqdm(configs.items(), desc="map sizes", leave=False):
        full = f"update, light, {name}"
        if setup.is_over():
            rows.append(Row(full, note=OUT_OF_TIME))
            break
        update = functools.partial(hio.update, map_frames(setup, config, 5).state)
        spread = time_ms(update, *setup.frame(5), seconds=setup.sizes.seconds)
        note = f"{'x'.join(map(str, config.grid_shape))} voxels"
        rows.append(Row(full, "ms", spread, "map size" if baseline else "", note=note))
        baseline = baseline or {"map size": [Baseline(name, spread)]}
    return Measured(rows, baseline)


def _cloud_size_updates(setup: Setup) -> dict[str, Callable[[], MapState]]:
    rng = np.random.default_rng(0)
    cloud, pose = setup.frame(0)
    cloud = cloud[np.isfinite(cloud).all(axis=-1)]
    updates, base = {}, setup.config("light", warmup_updates=0)
    for count in setup.sizes.cloud_sizes:
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


def _map_size_configs(setup: Setup) -> dict[str, hio.Config]:
    (_, _, low), (_, _, high) = setup.extent.bounds
    x, y, _ = setup.frame(0)[1][:3, 3].tolist()
    configs = {}
    for edge in setup.sizes.map_edges:
        half = edge / 2
        bounds = ((x - half, y - half, low), (x + half, y + half, high))
        configs[f"a map of {edge:g} m"] = setup.config("light", bounds=bounds, warmup_updates=0)
    return configs
