"""Scenarios of things that appear or jump between scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.robustness import library, measures
from benchmarks.robustness.library import Setup
from benchmarks.robustness.scenes import ROOM, frames_of, new_map, scan_all
from benchmarks.robustness.sensors import SENSORS, Scan, Sensor
from benchmarks.robustness.worlds import Box, World

Rows = dict[str, measures.Figures]

EMPTY_SCANS = (1, 12, 60)
SCANS_AFTER = 5
_NETWORK_SCANS_AFTER = 10

_HALF = (0.25, 0.3, 0.6)
_STANDING = Box((3.8, 2.5, 0.6), _HALF)
# A box that hangs: all of the place that it leaves is far from any surface.
HANGING = Box((3.8, 1.8, 1.3), _HALF)
JUMPED = Box((3.8, 3.2, 1.3), _HALF)


def appear(setup: Setup) -> Rows:
    """A box appears in space that was seen free for 1, 12 and 60 scans."""
    rows = {}
    world = World(ROOM, (_STANDING,))
    for sensor in (make() for make in SENSORS.values()):
        state = new_map(setup)
        done = 0
        for empty in EMPTY_SCANS:
            name = f"appears after {empty}, {sensor.name}"
            before = scan_all(setup, sensor, lambda _: World(ROOM), range(done, empty))
            state = library.play(state, frames_of(before), f"{name}: empty").state
            done = empty
            after = scan_all(setup, sensor, lambda _: world, range(empty, empty + SCANS_AFTER))
            changed = library.play(state, frames_of(after), name).state
            rng = setup.rng(1)
            rows[name] = (
                measures.solidity(changed, _STANDING, rng)
                | measures.visible_side(changed, after, [0])
                | measures.bounds_hold(changed, *measures.seen_points(sensor, after, world, rng))
            )
    return rows


def stand(setup: Setup) -> Rows:
    """The same box is there from the start: what a world without change allows."""
    rows, world = {}, World(ROOM, (_STANDING,))
    for sensor in (make() for make in SENSORS.values()):
        name = f"stands from the start, {sensor.name}"
        scans = scan_all(setup, sensor, lambda _: world, range(12 + SCANS_AFTER))
        state = library.play(new_map(setup), frames_of(scans), name).state
        latest, rng = scans[-SCANS_AFTER:], setup.rng(1)
        rows[name] = (
            measures.solidity(state, _STANDING, rng)
            | measures.visible_side(state, latest, [0])
            | measures.bounds_hold(state, *measures.seen_points(sensor, latest, world, rng))
        )
    return rows


def jump(setup: Setup) -> Rows:
    """A box is seen for 12 scans, and then 1.4 m beside."""
    rows = {}
    world = World(ROOM, (JUMPED,))
    for sensor in (make() for make in SENSORS.values()):
        name = f"jumps, {sensor.name}"
        before = scan_all(setup, sensor, lambda _: World(ROOM, (HANGING,)), range(12))
        state = library.play(new_map(setup), frames_of(before), f"{name}: before").state
        after = scan_all(setup, sensor, lambda _: world, range(12, 12 + _NETWORK_SCANS_AFTER))
        early = library.play(state, frames_of(after[:SCANS_AFTER]), name).state
        late = library.play(early, frames_of(after[SCANS_AFTER:]), name).state
        rng = setup.rng(1)
        figures = (
            measures.old_place(early, *place_left(world, rng, sensor, after[:SCANS_AFTER]))
            | measures.visible_side(early, after[:SCANS_AFTER], [0])
            | measures.solidity(early, JUMPED, rng)
            | measures.bounds_hold(
                early, *measures.seen_points(sensor, after[:SCANS_AFTER], world, rng)
            )
        )
        # The network has twice the scans.
        place = place_left(world, rng, sensor, after)
        figures["old_network"] = measures.old_place(late, *place)["old_network"]
        figures["side_network_cm"] = measures.visible_side(late, after, [0])["side_network_cm"]
        rows[name] = figures
    return rows


def place_left(
    world: World, rng: np.random.Generator, sensor: Sensor, scans: Sequence[Scan]
) -> tuple[np.ndarray, np.ndarray]:
    """Draws points of the place that the hanging box has left.

    Args:
        world: The world without it there.
        rng: Source of randomness.
        sensor: The sensor that looks there.
        scans: Its scans of the world.

    Returns:
        Points (n, 3) m and exact distances (n,) m.
    """
    return measures.draw_old_place(world, [HANGING], rng, sensor=sensor, scans=scans)
