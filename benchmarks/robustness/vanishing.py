"""How soon the place of a thing that has left is free, by `Config.vanish_scans`.

    python -m benchmarks.robustness.vanishing

A box is seen for 60 scans, and then 1.4 m beside. The scans are counted until 95 % of the place
that it has left is free again. Only what the sensor can see of the place in five scans counts.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import records
from benchmarks.robustness import library, measures
from benchmarks.robustness.changes import HANGING, JUMPED, SCANS_AFTER, place_left
from benchmarks.robustness.library import Setup
from benchmarks.robustness.scenes import BOUNDS, MAX_RANGE, ROOM, frames_of, scan_all
from benchmarks.robustness.sensors import SENSORS
from benchmarks.robustness.worlds import World

RECORD = records.RESULTS / "vanishing.json"
ANSWERS = {"sdf": "old", "lower": "old_lower", "network": "old_network", "frontier": "frontier"}
_VANISH_SCANS = (1, 3, 6, 12)
_SCANS_BEFORE = 60
MOST_SCANS = 40
_FREE_SHARE = 0.95


class Freed(NamedTuple):
    """How soon a place is free by one answer of the map.

    Attributes:
        scans: Scans until 95 % of it is free; None if 40 do not suffice.
        share: The share that is free after the last scan.
    """

    scans: int | None
    share: float


def count_scans(setup: Setup, sensor_name: str, vanish_scans: int) -> dict[str, Freed]:
    """Counts the scans until the place of a box that has left is free.

    Args:
        setup: The configuration and the seed.
        sensor_name: A name in `SENSORS`.
        vanish_scans: `Config.vanish_scans`.

    Returns:
        {answer: how soon}. A point is free for `sdf`, `lower` and the `network` alone if they reach
        90 % of its true distance, and for the `frontier` if that is positive.
    """
    sensor, left = SENSORS[sensor_name](), World(ROOM, (JUMPED,))
    config = setup.config(BOUNDS, MAX_RANGE)
    state = setup.new_map(dataclasses.replace(config, vanish_scans=vanish_scans))
    numbers = range(_SCANS_BEFORE)
    seen = scan_all(setup, sensor, lambda _: World(ROOM, (HANGING,)), numbers)
    label = f"vanish_scans={vanish_scans}, {sensor_name}"
    state = library.play(state, frames_of(seen), f"{label}: before").state
    numbers = range(_SCANS_BEFORE, _SCANS_BEFORE + MOST_SCANS)
    scans = scan_all(setup, sensor, lambda _: left, numbers)
    place, truth = place_left(left, setup.rng(1), sensor, scans[:SCANS_AFTER])
    found = dict.fromkeys(ANSWERS, Freed(None, 0.0))
    for number, frame in enumerate(frames_of(scans), start=1):
        state = library.play(state, [frame], label).state
        shares = measures.old_place(state, place, truth)
        shares["frontier"] = float(np.mean(library.frontier(state, place) > 0))
        for answer, figure in ANSWERS.items():
            scans_so_far = found[answer].scans
            if scans_so_far is None and shares[figure] >= _FREE_SHARE:
                scans_so_far = number
            found[answer] = Freed(scans_so_far, shares[figure])
        if all(each.scans for each in found.values()):
            break
    print(f"{label}: {found}", flush=True)
    return found


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness.vanishing")
    parser.add_argument("--config", default="light", choices=("light", "default"))
    parser.add_argument("--output", type=Path, metavar="FILE", help="write a record")
    options = parser.parse_args()
    setup = Setup(options.config, 0)
    rows: dict[str, Any] = {
        str(scans): {
            name: {
                answer: {"scans": each.scans, "share": records.rounded(each.share, 3)}
                for answer, each in count_scans(setup, name, scans).items()
            }
            for name in SENSORS
        }
        for scans in _VANISH_SCANS
    }
    if options.output:
        record = records.provenance() | {"config": options.config, "vanish_scans": rows}
        records.write(options.output, record)


if __name__ == "__main__":
    main()
