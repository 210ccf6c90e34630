"""Time and memory of a map, beside baselines and limits that are measured in the same run.

python -m benchmarks.speed --stream ../shared/data/house_depth.npz

- `setup` holds the sizes of a run, its configurations and its stream;
- `plan` lists the tasks: `processes`, `updates`, `scaling`, `stages`, `networks` and `queries`;
- `baselines` do the same work in scipy and, with `torch_siren`, in PyTorch;
- `limits` measures the machine and counts the least work of some rows;
- `rows` times, and lays the rows out as a table and a record.

It needs neither mujoco nor trimesh nor matplotlib. Without PyTorch its rows lack that baseline.
"""
