"""Saves a map to one file and loads it; a resumed run continues bit for bit."""

from __future__ import annotations

import dataclasses
import json
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.datasets.archive import Archive
from hiosdf_jax._src.datasets.files import parsing
from hiosdf_jax._src.mapping.derived import recompute_derived
from hiosdf_jax._src.mapping.lifecycle import init
from hiosdf_jax._src.mapping.stored_values import check_array, check_grid
from hiosdf_jax._src.numerics.intake import is_traced
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.pytrees import Grid, MapState

_FORMAT = "hiosdf_jax map"
_VERSION = 7

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
# there; those that follow from others are recomputed.
_SINCE = {
    3: ("grid.change", "report.points_moving", "report.refused_in_row", "report.update_flags"),
    4: ("grid.surface.side",),
}

# Fields of the configuration that files of older versions do not have, by the version that has
# them first, and the values that the code of the older version had in their place.
_FIELDS_SINCE = {3: {"min_in_range": 0.01, "most_refusals": 10, "vanish_scans": 3}}


def save(path: str | os.PathLike[str], state: MapState) -> None:
    """Writes the whole map to one compressed .npz file, without pickle.

    The file is replaced when all of it is on the disk, so that a crash keeps the old file. The
    permissions of an old file are kept. A link stays, and the file that it leads to is replaced.

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
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path is a {type(path).__name__}, expected the name of a file")
    check_map(state)
    if is_traced(*jax.tree.leaves(state)):
        raise ValueError("state is traced, expected a map: call save outside jit")
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


def is_map(path: str | os.PathLike[str]) -> bool:
    """Returns whether a file is a map, judged by its header alone."""
    try:
        with Archive(path) as archive:
            _read_header(archive)
    except ValueError:
        return False
    return True


def read_progress(path: str | os.PathLike[str]) -> Any:
    """Reads the notes of `save_with_progress`.

    Args:
        path: A file that `load` has read.

    Returns:
        The notes as they are in the file; None if it has none.
    """
    with Archive(path) as archive:
        return json.loads(str(archive.read("header"))).get("progress")


def load(path: str | os.PathLike[str]) -> MapState:
    """Reads a map that `save` wrote.

    Args:
        path: The file.

    Returns:
        The map, as it was.

    Raises:
        ValueError: The file is not a map, is damaged, has values that no map has, or another
            version. The message names the file and the problem.
        FileNotFoundError: There is no such file.
        IsADirectoryError: It is a folder.

    Example:
        >>> state = hio.load("house.npz")
    """
    with Archive(path) as archive:
        version, config, key_impl = _read_header(archive)
        template = jax.eval_shape(
            lambda: _without_key(init(config, jax.random.key(0, impl=key_impl)))
        )
        expected = _named_leaves(template)
        later = {name for since, names in _SINCE.items() if version < since for name in names}
        for name in sorted(archive.names - {"header"} - expected.keys() | archive.names & later):
            shown = name if name.isprintable() else ascii(name)
            raise ValueError(f"{path} has the unknown array {shown}")
        for name, leaf in expected.items():  # all, before one is inflated
            if name not in archive.names | later:
                raise ValueError(f"{path} lacks the array {name}")
            if name not in later:
                entry = archive.describe(name)
                if entry.shape != leaf.shape or entry.dtype != leaf.dtype:
                    raise ValueError(
                        f"{path} has {name} of {entry.dtype} {entry.shape}, "
                        f"expected {leaf.dtype} {leaf.shape}"
                    )
        leaves = [
            jnp.zeros(leaf.shape, leaf.dtype)
            if name in later
            else jnp.asarray(_read_checked(archive, name))
            for name, leaf in expected.items()
        ]
    state = jax.tree.unflatten(jax.tree.structure(template), leaves)
    if version < 7:
        state = state.replace(grid=_of_older_file(version, config, state.grid))
    check_grid(path, config, state.grid)
    return state.replace(key=jax.random.wrap_key_data(state.key, impl=key_impl))


def _read_header(archive: Archive) -> tuple[int, Config, str]:
    """The format version, the configuration and the kind of random key, all checked."""
    path = archive.path
    with parsing(path, "hiosdf_jax map"):
        if "header" not in archive.names:
            raise ValueError("it has no header")
        text = archive.read("header")
        if text.dtype.kind != "U" or text.shape != ():
            raise ValueError(f"its header is {text.dtype} {text.shape}, expected text")
        header = json.loads(str(text))
        if not isinstance(header, dict) or header.get("format") != _FORMAT:
            raise ValueError("it has no such header")
        missing = {"version", "config", "key"} - header.keys()
        if missing:
            raise ValueError(f"its header lacks {sorted(missing)}")
        version, fields, key_impl = header["version"], header["config"], header["key"]
        if not isinstance(fields, dict) or key_impl not in ("threefry2x32", "rbg", "unsafe_rbg"):
            raise ValueError(f"its header has the key {key_impl!r} and the config {fields!r}")
    if type(version) is not int or version not in range(2, _VERSION + 1):
        raise ValueError(
            f"{path} has format version {version!r}, expected 2 to {_VERSION}; a map of another "
            "version must be made again from its recording"
        )
    fields = dict(fields)
    for since, added in _FIELDS_SINCE.items():
        if version < since:
            fields = added | fields
    names = {field.name for field in dataclasses.fields(Config)}
    if fields.keys() != names:
        raise ValueError(
            f"{path} has no valid configuration: it lacks {sorted(names - fields.keys())} and has "
            f"the unknown {sorted(fields.keys() - names)}"
        )
    try:
        return version, Config(**fields), key_impl
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} has no valid configuration: {error}") from error


def _read_checked(archive: Archive, name: str) -> np.ndarray:
    array = archive.read(name, whole=True)
    check_array(archive.path, name, array)
    return array


def _of_older_file(version: int, config: Config, grid: Grid) -> Grid:
    """Turns axes to be right-handed, and computes what follows from the evidence as it is now."""
    if version < 4:
        axes = grid.evidence.axes
        turned = jnp.linalg.det(axes.astype(jnp.float32)) < 0
        middle = jnp.where(turned[..., None], -axes[..., 1, :], axes[..., 1, :])
        evidence = grid.evidence.replace(axes=axes.at[..., 1, :].set(middle))
        grid = grid.replace(evidence=evidence)
    return jax.jit(recompute_derived, static_argnums=0)(config, grid)


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
