"""Accuracy on streams: the grid alone, the network alone and what is served, beside the peers.

python -m benchmarks.accuracy --data ../shared/data --streams house_depth --configs light

- `measure` maps a stream and scores it;
- `results` gathers the figures of several seeds, and lays them out as a table;
- `gate` tells which figures are worse than in a committed baseline;
- `figure` draws the error over time.

It needs neither mujoco nor trimesh nor matplotlib; what it leaves out without them it says.
"""
