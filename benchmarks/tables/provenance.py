"""The table of the committed records: what each is measured on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from benchmarks import records
from benchmarks.tables.markdown import lay_out


def list_records() -> str:
    """Devices and versions of jax, by record."""
    cells = []
    for path in sorted(records.RESULTS.glob("*.json")):
        entries = list(_entries(records.read(path)))
        cells.append(
            [f"`{path.name}`", *(_together(entry[key] for entry in entries) for key in _KEYS)]
        )
    return lay_out(["record", "device", "jax"], cells)


TABLES = {"records": list_records}

_KEYS = ("device", "jax")


def _together(values: Iterable[str]) -> str:
    """Names each value once; an entry that pools runs names several itself."""
    return ", ".join(dict.fromkeys(one for value in values for one in value.split(", ")))


def _entries(value: Any) -> Iterator[dict[str, Any]]:
    """The parts of a record that say what they are measured on."""
    if isinstance(value, dict) and "revision" in value:
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _entries(item)
