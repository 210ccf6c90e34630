"""Committed records: small JSON files that say what was measured, where, and at which revision."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hiosdf_jax._src.command.report import to_json
from hiosdf_jax._src.output_files import replacing

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"

_WIDTH = 100  # characters of a line, unless an innermost list or object has more


def provenance() -> dict[str, str]:
    """Names what a run is measured on.

    Returns:
        The device, the version of jax and the revision of this checkout; "unknown" outside of one.
    """
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=7"]
    try:
        revision = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        revision = "unknown"
    return {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "revision": revision.strip(),
    }


def read(path: Path) -> Any:
    """Reads a record.

    Args:
        path: The file.

    Returns:
        What `write` was given; an empty dict if there is no such file.
    """
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def write(path: Path, value: Any) -> None:
    """Writes a record with each innermost list or object on one line, short ones side by side.

    Args:
        path: The file; its folder is made if it is not there.
        value: Dicts, lists, strings and numbers. Numbers that are not finite become null.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    text = _lay_out(to_json(value), "") + "\n"
    with replacing(path) as file:
        file.write(text.encode())


def rounded(value: float, digits: int = 6) -> float:
    """Rounds a number to significant digits; tables show fewer."""
    return float(f"{value:.{digits}g}")


def percentiles(
    values: Sequence[float] | np.ndarray, shares: Sequence[int] = (10, 50, 90)
) -> dict[str, float]:
    """Computes percentiles of measurements.

    Args:
        values: The measurements.
        shares: Percentages; 50 is the median.

    Returns:
        {"p10": ..., "median": ..., "p90": ...} for the default shares; empty without measurements.
    """
    if not len(values):
        return {}
    found = np.percentile(np.asarray(values, float), shares)
    names = ("median" if share == 50 else f"p{share}" for share in shares)
    return {name: float(value) for name, value in zip(names, found, strict=True)}


def _lay_out(value: Any, indent: str) -> str:
    pairs = value.items() if isinstance(value, dict) else [("", item) for item in value]
    if not any(isinstance(item, dict | list) for _, item in pairs):
        return json.dumps(value)
    deeper, lines = indent + " ", []
    for key, item in pairs:
        text = _lay_out(item, deeper) if isinstance(item, dict | list) else json.dumps(item)
        text = f"{json.dumps(key)}: {text}" if isinstance(value, dict) else text
        if lines and len(lines[-1]) + len(text) + 3 <= _WIDTH and "\n" not in lines[-1] + text:
            lines[-1] += f", {text}"
        else:
            lines.append(deeper + text)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return "\n".join([opening, ",\n".join(lines), indent + closing])
