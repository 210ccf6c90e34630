"""What a saved map is, in plain words: `hiosdf info`."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np

from hiosdf_jax._src.command.report import FLAG_WORDS
from hiosdf_jax._src.mapping import checkpoint
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import MapState, field_of

_PRESETS = ("light", "default", "paper")


def describe_map(path: str | os.PathLike[str], state: MapState) -> str:
    """Describes a map that was read from a file.

    Args:
        path: The file.
        state: The map in it.

    Returns:
        Several lines: extent, voxels, what is observed, updates, memory, problems, configuration.
    """
    config, derived = state.config, state.grid.derived
    low, high = np.asarray(config.bounds)
    observed = np.asarray(derived.frontier_steps) > 0
    axes = ", ".join(
        f"{name} {a:.2f} to {b:.2f} m" for name, a, b in zip("xyz", low, high, strict=True)
    )
    shape = " x ".join(map(str, config.grid_shape))
    lines = [
        f"{os.fspath(path)}: a map after {int(state.updates)} updates",
        f"  extent    {axes}",
        f"  voxels    {shape} = {observed.size:,} of {config.voxel_size:g} m, "
        f"{100 * observed.mean():.0f} % observed",
        f"  memory    {_megabytes(state)} as a map, {_megabytes(field_of(state))} as a snapshot, "
        f"{Path(path).stat().st_size / 1e6:.1f} MB as a file",
        f"  network   {config.hidden_layers + 1} layers of {config.hidden_width}, "
        f"{sum(each.size for each in jax.tree.leaves(state.network.average)):,} weights",
    ]
    if int(state.updates):
        report = state.report
        lines.append(
            f"  last      {int(report.points_used)} points used, {int(report.points_outside)} "
            f"outside the bounds, loss {100 * float(report.sdf_loss):.1f} cm"
        )
    notes = checkpoint.read_progress(path)
    if isinstance(notes, dict) and isinstance(notes.get("next_frame"), int):
        lines.append(f"  stream    the next frame is number {notes['next_frame']}")
    flags = Flag(int(state.report.flags))
    named = [f"{flag.name}: {FLAG_WORDS[flag]}" for flag in Flag if flag in flags]
    lines.append(f"  problems  {'in some update so far' if named else 'none'}")
    lines += [f"    {each}" for each in named]
    return "\n".join([*lines, *_describe_config(state)])


def _describe_config(state: MapState) -> list[str]:
    """The preset that is nearest to the configuration, and what differs from it."""
    config = state.config
    fields = [each.name for each in dataclasses.fields(config) if each.name != "bounds"]
    differences = {}
    for name in _PRESETS:
        preset = getattr(type(config), name)(config.bounds)
        differences[name] = [
            f"{each} = {getattr(config, each)!r}"
            for each in fields
            if getattr(config, each) != getattr(preset, each)
        ]
    nearest = min(differences, key=lambda name: len(differences[name]))
    changes = differences[nearest]
    lines = [f"  config    Config.{nearest}{', but' if changes else ''}"]
    return lines + [f"    {each}" for each in changes]


def _megabytes(tree: object) -> str:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "nbytes")]
    return f"{sum(leaf.nbytes for leaf in leaves) / 1e6:.1f} MB"
