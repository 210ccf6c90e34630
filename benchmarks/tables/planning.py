"""Tables of what a planner does with a map: clearances, a blind corner, an exploring robot."""

from __future__ import annotations

from benchmarks import records
from benchmarks.tables.markdown import lay_out
from hiosdf_jax._src.command.timing import format_number


def clearances() -> str:
    """Times of sphere clearances with gradient by what is asked, and of swept clearances."""
    cells = []
    for name in ("default_h100", "paper_h100", "default_cpu"):
        record = records.read(records.RESULTS / f"planning_{name}.json")
        times = record["times_ms"]
        cells.append(
            [
                f"`Config.{record['config']}`, {_device(record['device'])}, {record['count']:,}",
                *(format_number(times[how]["median"]) for how in _HOW),
            ]
        )
    return lay_out(["spheres, ms", *_HOW.values()], cells)


def corner() -> str:
    """Runs around a blind corner by what unseen space is taken for."""
    record = records.read(records.RESULTS / "blind_corner.json")
    cells = []
    for unknown in ("obstacle", "network"):
        row = record[unknown]
        counts = [str(row[key]) for key in ("runs", "collided", "reached_without_collision")]
        cells.append([f'`unknown="{unknown}"`', *counts, f"{row['median_seconds']:.1f} s"])
    columns = ["runs", "collisions", "goals reached without one", "median time to the end"]
    return lay_out(["blind corner", *columns], cells)


def explore() -> str:
    """Runs of the exploring robot in the demo's apartment."""
    record = records.read(records.RESULTS / "explore.json")
    cells = [str(record[key]) for key in ("runs", "reached", "collided")]
    cells.append(f"{100 * record['least_clearance_m']:.1f} cm")
    cells += [f"{record[key]:.0f} s" for key in ("median_command_s", "longest_command_s")]
    columns = ["goals reached", "collisions", "least clearance", "command, median", "longest"]
    return lay_out(["runs", *columns], [cells])


TABLES = {"planning": clearances, "blind-corner": corner, "explore": explore}

_HOW = {
    "baked": "baked field",
    "swept": "baked field, swept",
    "blended": "map",
    "network": "network alone",
}


def _device(kind: str) -> str:
    return "two CPU cores" if kind == "cpu" else kind.removeprefix("NVIDIA ").split()[0]
