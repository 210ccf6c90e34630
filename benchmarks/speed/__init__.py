"""Time and memory of a map, beside baselines and limits that are measured in the same run.

python -m benchmarks.speed --stream ../shared/data/house_depth.npz

- `tasks` says what is measured; `stages` takes an update apart;
- `baselines` are the same work in scipy and, in `torch_siren`, in PyTorch;
- `limits` measures the machine, and counts the work that a stage cannot avoid;
- `rows` times, and lays the rows out as a table.

It needs neither mujoco nor trimesh nor matplotlib; without PyTorch its rows lack that baseline.
"""
