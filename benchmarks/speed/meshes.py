"""The task that times meshes of the whole stream's map."""

from __future__ import annotations

import time

import hiosdf_jax as hio
from benchmarks.speed.rows import Measured, Row, spread_of
from benchmarks.speed.setup import Setup
from benchmarks.speed.updates import map_frames

RESOLUTIONS_M = (0.05, 0.025)
_REPEATS = 3


def extract_meshes(setup: Setup, label: str) -> Measured:
    """Times `extract_mesh` after a call that warms up.

    Args:
        setup: The run's setup.
        label: Name of the configuration.

    Returns:
        Rows in s.
    """
    config = setup.config(label)
    state = map_frames(setup, config, len(setup.frames) - max(config.warmup_updates, 1)).state
    rows = []
    for resolution in RESOLUTIONS_M:
        times_s = []
        for _ in range(1 + _REPEATS):
            start = time.perf_counter()
            mesh = hio.extract_mesh(state, resolution)
            times_s.append(time.perf_counter() - start)
        note = f"{len(mesh.faces):,} triangles; the first call took {times_s[0]:.2g} s"
        name = f"mesh of {resolution} m, {label}"
        rows.append(Row(name, "s", spread_of(times_s[1:]), note=note))
    return Measured(rows)
