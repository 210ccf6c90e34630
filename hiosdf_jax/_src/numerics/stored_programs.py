"""Traced programs that outlive a process, in the folder of JAX's persistent cache.

The persistent cache keeps compiled programs. To find one, JAX must trace and lower the function
again, and for an update that takes longer than all the rest. Here `jax.export` stores the lowered
program as well.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import jax
import jax.export
import numpy as np

from hiosdf_jax._src.output_files import replacing

_PACKAGE = __name__.split(".")[0]
_LIBRARIES = ("jax", "jaxlib", "optax", "flax", "numpy")
_DIGEST_BYTES = hashlib.sha256().digest_size
_FOLDER = "jax_compilation_cache_dir"


def stored[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function that is not traced where an earlier process has traced it.

    It is for the outermost `jax.jit` alone: a stored program has no derivatives and no batching
    rule, and runs on one device. Without a persistent cache, and on a GPU, the function is traced
    as usual: a process that has not traced our kernels lacks what they need to run.

    A program is used only where the source files of this package, the versions of its libraries,
    JAX's settings, the kind of device and the types of the arguments are those of the process that
    stored it. Constants that a test or an experiment has replaced count, too. A module in which a
    function was replaced stores nothing.

    Args:
        function: A function of pytrees of arrays that `jax.export` can write.

    Returns:
        The same function, to be compiled.

    Example:
        >>> compiled = jax.jit(stored(function))
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        folder, types = _folder(), jax.tree.map(_type_of, args)
        key = folder and _key(function, types)
        if not (folder and key) or kwargs:
            return function(*args, **kwargs)
        path = folder / f"{_PACKAGE}-{key}.stablehlo"
        program = _read(path) or _write(path, function, types)
        return cast(R, program.call(*args))

    return call


def is_on_default_device(array: jax.Array) -> bool:
    """Returns whether an array lies on the device that JAX uses by default, and on no other."""
    chosen = jax.config.jax_default_device
    return array.devices() == {chosen or jax.local_devices()[0]}


def _folder() -> Path | None:
    """Returns the folder of the persistent cache, or None where programs cannot be stored."""
    folder = getattr(jax.config, _FOLDER)
    usable = (
        folder
        and "://" not in folder
        and jax.config.jax_enable_compilation_cache
        and not jax.config.jax_disable_jit
        and jax.default_backend() == "cpu"
        and jax.sharding.get_abstract_mesh().empty
    )
    return Path(folder) if usable else None


def _type_of(leaf: Any) -> jax.ShapeDtypeStruct:
    kind: Any = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _read(path: Path) -> jax.export.Exported | None:
    """Reads a program; None if there is none, or the file is damaged."""
    with contextlib.suppress(OSError):
        data = path.read_bytes()
        content = data[_DIGEST_BYTES:]
        if data[:_DIGEST_BYTES] == hashlib.sha256(content).digest():
            return jax.export.deserialize(bytearray(content))
    return None


def _write(path: Path, function: Callable, types: Any) -> jax.export.Exported:
    """Traces a function and stores its program, if the folder can be written."""
    # JAX would reuse what it has traced of the same function object, with the old constants.
    fresh = jax.jit(functools.partial(function))
    program = jax.export.export(fresh)(*types)
    content = bytes(program.serialize())
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(hashlib.sha256(content).digest() + content)
    return program


def _key(function: Callable, types: Any) -> str | None:
    """Names all that a traced program depends on; None if a function was replaced in memory."""
    content = sorted(_globals(sys.modules[function.__module__]))
    if any("<locals>" in line or "<lambda>" in line for line in content):
        return None
    settings = {name: getattr(jax.config, name, value) for name, value in jax.config.values.items()}
    device = jax.local_devices()[0]
    leaves, structure = jax.tree.flatten(types)
    parts = (
        _source_digest(),
        content,
        sorted((name, repr(value)) for name, value in settings.items() if name != _FOLDER),
        (jax.default_backend(), device.device_kind, jax.device_count()),
        (function.__qualname__, str(structure), [str(leaf) for leaf in leaves]),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@functools.cache
def _source_digest() -> str:
    """Returns a digest of this package's source files and of its libraries' versions."""
    digest = hashlib.sha256(sys.version.encode())
    for name in _LIBRARIES:
        digest.update(f"{name} {importlib.metadata.version(name)}\n".encode())
    root = Path(__file__).parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def _globals(start: ModuleType) -> Iterator[str]:
    """Describes the globals of a module, and of the modules of this package that it uses."""
    todo, seen = [start], {start.__name__}
    while todo:
        module = todo.pop()
        for name, value in vars(module).items():
            if name.startswith("__"):
                continue
            yield f"{module.__name__}.{name} = {_describe(value)}"
            used = value if isinstance(value, ModuleType) else sys.modules.get(_home(value))
            if used and used.__name__.split(".")[0] == _PACKAGE and used.__name__ not in seen:
                seen.add(used.__name__)
                todo.append(used)


def _describe(value: Any) -> str:
    """Returns the value of a constant, and the name of anything else."""
    if isinstance(value, tuple):
        return f"({', '.join(map(_describe, value))})"
    if isinstance(value, (bool, int, float, str, np.generic)):
        return repr(value)
    if isinstance(value, ModuleType):
        return value.__name__
    named = value if hasattr(value, "__qualname__") else type(value)
    return f"{_home(named)}.{named.__qualname__}"


def _home(value: Any) -> str:
    """Returns the name of the module that a function or a class comes from."""
    home = getattr(value, "__module__", "")
    return home if isinstance(home, str) else ""
