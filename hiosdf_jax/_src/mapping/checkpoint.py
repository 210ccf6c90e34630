"""Saves a map to one file and loads it; a resumed run continues bit by bit."""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.distance import recompute_distances
from hiosdf_jax._src.mapping.pipeline import init
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state import Grid, MapState, check_map

_FORMAT = "hiosdf_jax map"
_VERSION = 4

# Names in the file are part of its format; attributes of the code may be renamed.
_FILE_NAMES = {
    "grid.evidence.root_weight": "grid.weight",
    "grid.evidence.mean": "grid.surface.mean",
    "grid.evidence.axes": "grid.surface.axes",
    "grid.evidence.": "grid.",
    "grid.derived.frontier_steps": "grid.surface.frontier",
    "grid.derived.": "grid.surface.",
    "network.average.": "network.served.",
}

# Arrays that files of older versions do not have, by the version that has them first. They are zero
# there; those that follow from others are computed anew.
_SINCE = {
    3: ("grid.change", "report.points_moving", "report.refused_in_row", "report.update_flags"),
    4: ("grid.surface.side",),
}

# Raised by numpy and zipfile for damaged files and for files that are no archives.
_UNREADABLE = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, TypeError, KeyError)


def save(path: str | os.PathLike[str], state: MapState) -> None:
    """Writes the whole map to one compressed .npz file, without pickle.

    The file is replaced when all of it is on the disk, so that a crash keeps the old file. The
    rights of an old file are kept. A link stays, and the file that it leads to is replaced.

    Args:
        path: The file; its folder must exist.
        state: The map.

    Raises:
        ValueError: `state` is not a map.
        FileNotFoundError: There is no such folder.
        OSError: The file cannot be written: it is read-only or a folder, or the disk is full.

    Example:
        >>> hio.save("house.npz", state)
    """
    save_with_progress(path, state, None)


def save_with_progress(
    path: str | os.PathLike[str], state: MapState, progress: dict[str, Any] | None
) -> None:
    """Writes a map as `save` does, with notes on how far it has come in its stream.

    Args:
        path: The file; its folder must exist.
        state: The map.
        progress: Names and values that JSON can hold, for `read_progress`; None for no notes.

    Raises:
        ValueError: `state` is not a map.
        OSError: As for `save`.
    """
    check_map(state)
    header = {
        "format": _FORMAT,
        "version": _VERSION,
        "config": dataclasses.asdict(state.config),
        "key": str(jax.random.key_impl(state.key)),
    }
    if progress is not None:
        header["progress"] = progress  # `load` ignores it
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(_without_key(state)).items()}
    arrays["header"] = np.asarray(json.dumps(header))
    with replacing(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_progress(path: str | os.PathLike[str]) -> Any:
    """Reads the notes of `save_with_progress`.

    Args:
        path: A file that `load` has read.

    Returns:
        The notes as they are in the file; None if it has none.
    """
    with np.load(path, allow_pickle=False) as file:
        return json.loads(str(file["header"])).get("progress")


def load(path: str | os.PathLike[str]) -> MapState:
    """Reads a map that `save` wrote.

    Args:
        path: The file.

    Returns:
        The map, as it was.

    Raises:
        ValueError: The file is not a map, is damaged, or has another version. The message names the
            file and the problem.
        FileNotFoundError: There is no such file.

    Example:
        >>> state = hio.load("house.npz")
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise
    except _UNREADABLE as error:
        # numpy suggests to unpickle files of other kinds.
        reason = "it is none" if "pickle" in str(error) else error
        raise ValueError(f"{path} is not a readable .npz file: {reason}") from error
    try:
        header = json.loads(str(arrays.pop("header")))
        if header["format"] != _FORMAT:
            raise KeyError
        version, fields, key_impl = header["version"], header["config"], header["key"]
    except (KeyError, TypeError, json.JSONDecodeError):
        raise ValueError(f"{path} is not a hiosdf_jax map: it has no such header") from None
    if version not in range(2, _VERSION + 1):
        raise ValueError(f"{path} has format version {version}, expected 2 to {_VERSION}")
    try:
        config = Config(**fields)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} has no valid configuration: {error}") from error
    template = jax.eval_shape(lambda: _without_key(init(config, jax.random.key(0, impl=key_impl))))
    expected = _named_leaves(template)
    for since, names in _SINCE.items():
        if version < since:
            new = {name: np.zeros(expected[name].shape, expected[name].dtype) for name in names}
            arrays = new | arrays
    for name, leaf in expected.items():
        if name not in arrays:
            raise ValueError(f"{path} lacks the array {name}")
        if arrays[name].shape != leaf.shape or arrays[name].dtype != leaf.dtype:
            raise ValueError(
                f"{path} has {name} of {arrays[name].dtype} {arrays[name].shape}, "
                f"expected {leaf.dtype} {leaf.shape}"
            )
    leaves = [jnp.asarray(arrays[name]) for name in expected]
    state = jax.tree.unflatten(jax.tree.structure(template), leaves)
    if version < 4:
        state = state.replace(grid=_with_sides(config, state.grid))
    return state.replace(key=jax.random.wrap_key_data(state.key, impl=key_impl))


def _with_sides(config: Config, grid: Grid) -> Grid:
    """Turns the axes of the grid of an older file to be right-handed, and computes its sides."""
    axes = grid.evidence.axes
    turned = jnp.linalg.det(axes.astype(jnp.float32)) < 0
    middle = jnp.where(turned[..., None], -axes[..., 1, :], axes[..., 1, :])
    evidence = grid.evidence.replace(axes=axes.at[..., 1, :].set(middle))
    return jax.jit(recompute_distances, static_argnums=0)(config, grid.replace(evidence=evidence))


def _without_key(state: MapState) -> MapState:
    """Replaces the typed key by plain numbers, which a file can hold."""
    return state.replace(key=jax.random.key_data(state.key))


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    names = (jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves)
    return {_file_name(name): leaf for name, (_, leaf) in zip(names, leaves, strict=True)}


def _file_name(name: str) -> str:
    for prefix, in_file in _FILE_NAMES.items():
        if name.startswith(prefix):
            return in_file + name.removeprefix(prefix)
    return name
