"""Tables of times: a GPU, two CPU cores, and how much they vary from run to run."""

from __future__ import annotations

from typing import Any

from benchmarks import records
from benchmarks.tables.markdown import lay_out
from hiosdf_jax._src.command.timing import format_number
from hiosdf_jax._src.mapping.stages import STAGES

_QUERY = "sdf and gradient of 102,400"
Record = dict[str, Any]  # what the command `benchmarks.speed` writes


def gpu() -> str:
    """Updates, training and queries on one GPU."""
    record = _record("gpu")
    training = "the paper's training, 10 epochs of 60,000"
    rows = {
        "an update, `Config.default`": "update, default",
        "an update, `Config.paper`": "update, paper",
        "the same, the old map donated": "update, paper, donated",
        "the paper's training, 10 epochs of 60,000 samples": training,
        "102,400 distances with gradient, the paper's network": f"{_QUERY}, the paper's network",
        "102,400 distances with gradient, `Config.default`": f"{_QUERY}, blended, default",
        "1,048,576 distances with gradient, baked at 5 cm": (
            "sdf and gradient of 1,048,576, baked, default"
        ),
        "an update, `Config.light`, map of 10 m": "update, light, a map of 10 m",
        "an update, `Config.light`, map of 60 m": "update, light, a map of 60 m",
    }
    cells = [
        [
            label,
            _number(_row(record, name), "median"),
            _number(_row(record, name), "p99"),
            _number(_row(record, f"{name}, on the device alone"), "median"),
            "" if name.startswith("update") else _number(_beside(record, name), "median"),
        ]
        for label, name in rows.items()
    ]
    columns = ["median", "p99", "compiled function alone", "PyTorch eager, TF32"]
    return lay_out([f"one {_card(record)}, ms", *columns], cells)


def cpu() -> str:
    """Updates, a whole run, training and queries on two CPU cores."""
    record = _record("cpu")
    rows = {
        "an update, `Config.light`": "update, light",
        "the first update, which compiles": "compilation of update, light",
        "`hiosdf map` of the house: maps, scores, draws": "hiosdf map, the whole stream, light",
        "its peak of resident memory": "resident memory, peak of hiosdf map",
        "the map's arrays": "arrays of the map, light",
        "`extract_mesh` of the house, 5 cm": "mesh of 0.05 m, light",
        "`extract_mesh` of the house, 2.5 cm": "mesh of 0.025 m, light",
        "102,400 distances with gradient, `Config.light`": f"{_QUERY}, blended, light",
        "102,400 distances with gradient, the grid alone": f"{_QUERY}, grid, light",
        "102,400 distances with gradient, the paper's network": f"{_QUERY}, the paper's network",
        "the paper's training, 1 epoch of 60,000 samples": (
            "the paper's training, 1 epochs of 60,000"
        ),
    }
    cells = []
    for label, name in rows.items():
        row = _row(record, name)
        beside = _beside(record, name) if "the paper's" in name else {}
        unit = row["unit"]
        cells.append([label, *(_with_unit(one, unit) for one in (row, beside))])
    return lay_out(["two CPU cores", "median", "PyTorch eager"], cells)


def stages() -> str:
    """The stages of an update one by one, on a GPU and on two CPU cores."""
    gpu, cpu = _record("gpu"), _record("cpu")
    known = {stage.__name__ for stage in STAGES}
    names = [row["name"].removesuffix(", paper") for row in gpu["rows"]]
    cells = [
        [
            ", ".join(f"`{stage}`" for stage in name.split(" + ")),
            _number(_row(gpu, f"{name}, paper"), "median"),
            _number(_row(cpu, f"{name}, light"), "median"),
        ]
        for name in names
        if known.issuperset(name.split(" + "))  # a record may have two stages in one row
    ]
    columns = [f"{_card(gpu)}, `Config.paper`", "two CPU cores, `Config.light`"]
    return lay_out(["stage, ms", *columns], cells)


def ratios() -> str:
    """How an update grows with the map and with the number of updates."""
    record = _record("gpu")
    sizes = [_row(record, f"update, light, a map of {edge} m") for edge in (60, 10)]
    ending = " updates in a row, light, last 10 %"  # fewer than planned if the time ran out
    last = next(row["name"] for row in record["rows"] if row["name"].endswith(ending))
    ends = [_row(record, last), _beside(record, last)]
    cells = [
        [label, f"{one['median'] / other['median']:.2f}"]
        for label, (one, other) in (
            ("map of 60 m : map of 10 m around the same sensor", sizes),
            (f"last tenth of {last.removesuffix(ending)} updates : first tenth", ends),
        )
    ]
    return lay_out([f"`Config.light`, one {_card(record)}, medians", "ratio"], cells)


def many() -> str:
    """Points one by one, and many small maps, on one GPU."""
    record = _record("gpu")
    cells = []
    for count in ("102,400", "1,048,576"):
        for function in ("sdf", "value_and_grad(sdf)"):
            name = f"vmap({function}) of {count}, default"
            row, beside = (_number(found(record, name), "median") for found in (_row, _beside))
            cells.append([f"`vmap({function})` of {count} points, `Config.default`", row, beside])
    maps = "1,024 maps of 4 x 4 x 2 m"
    for label, name in (
        (f"an update of {maps}", f"update of {maps}"),
        ("256 distances in each of them", f"256 distances in each of {maps}"),
    ):
        cells.append([label, _number(_row(record, name), "median"), ""])
    return lay_out([f"one {_card(record)}, ms", "median", "as one batch"], cells)


TABLES = {
    "speed-gpu": gpu,
    "speed-many": many,
    "speed-cpu": cpu,
    "speed-stages": stages,
    "speed-ratios": ratios,
}


def _record(device: str) -> Record:
    return records.read(records.RESULTS / f"speed_{device}.json")


def _card(record: Record) -> str:
    """The GPU's short name, such as H200 for NVIDIA H200."""
    return record["device"].split()[1]


def _row(record: Record, name: str) -> dict[str, Any]:
    """A row by its name; empty if the record has none."""
    return next((row for row in record["rows"] if row["name"] == name), {})


def _beside(record: Record, name: str) -> dict[str, Any]:
    """The last baseline of a row; empty if it has none."""
    found = record["baselines"].get(_row(record, name).get("compare"))
    return found[-1] if found else {}


def _number(row: dict[str, Any], key: str) -> str:
    return format_number(row[key]) if key in row else ""


def _with_unit(row: dict[str, Any], unit: str) -> str:
    if "median" not in row:
        return ""
    value = row["median"]
    larger = {"ms": "s", "MB": "GB"}
    if value >= 1000 and unit in larger:
        value, unit = value / 1000, larger[unit]
    return f"{format_number(value)} {unit}"
