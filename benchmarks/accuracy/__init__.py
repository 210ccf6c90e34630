"""Accuracy on streams: the grid alone, the network alone and both blended, beside the peers.

python -m benchmarks.accuracy --data ../shared/data --streams house_depth --configs light

- `sources` opens the streams, and `measure` maps and scores them;
- `results` gathers the figures of several seeds, lays them out as a table and writes their record;
- `gate` finds the figures that are worse than in a committed baseline;
- `figure` draws the error over time;
- `gradient_parts` says what the error of the gradient near surfaces is made of.

It needs neither mujoco nor trimesh nor matplotlib, and says what it leaves out without them.
"""
