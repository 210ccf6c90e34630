"""Robustness: worlds that change, things that move, sensors that lie.

    python -m benchmarks.robustness --config light

- `worlds` has shapes with exact distances and a ray caster, `sensors` scans them;
- `scenes` has the furnished room and the paths of the sensors;
- `changes`, `movers`, `faults` and `apartment` are the scenarios, one function per row group;
- `library` calls the map, and `measures` scores it;
- `endurance` updates one small map 10,000 times, a command of its own;
- `gate` compares the figures with the bars and with a committed baseline.
"""
