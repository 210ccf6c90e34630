"""Metrics as a table of two columns, for spreadsheets and data frames."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator
from typing import Any

from hiosdf_jax._src.output_files import replacing


def write_csv(path: str | os.PathLike[str], metrics: dict[str, Any]) -> None:
    """Writes metrics as CSV: a name and a value in each row.

    Example:
        >>> scoring.write_csv("metrics.csv", json.loads(Path("metrics.json").read_text()))

    Args:
        path: The file.
        metrics: Nested dicts, lists and scalars, as in `metrics.json`. Names are joined by dots,
            members of lists are numbered, and None becomes an empty value.

    Raises:
        ValueError: `metrics` is not a dict.
        OSError: The file cannot be written.
    """
    if not isinstance(metrics, dict):
        raise ValueError(f"metrics is {type(metrics).__name__}, expected a dict")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["name", "value"])
    writer.writerows(_rows("", metrics))
    with replacing(path) as file:
        file.write(text.getvalue().encode())


def _rows(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict | list | tuple):
        members = value.items() if isinstance(value, dict) else enumerate(value)
        for key, member in members:
            yield from _rows(f"{name}.{key}" if name else str(key), member)
    else:
        yield name, value
