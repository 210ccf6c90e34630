"""Maps a depth stream with Open3D's TSDF, a peer, and writes its mesh.

It needs `pip install open3d` (0.20, 400 MB) in an environment of its own, and nothing of this
project. `python -m benchmarks.accuracy.score_mesh` scores the mesh.
"""

import argparse
import time

import numpy as np
import open3d  # pyright: ignore[reportMissingImports]

_DEVICE = open3d.core.Device("CPU:0")
_BLOCK = 16  # voxels along each side of a block

# Open3D rounds projected pixel coordinates down, so it expects the center of the first pixel at
# (0.5, 0.5). The streams have it at (0, 0).
_PIXEL_CENTER = 0.5


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python benchmarks/accuracy/open3d_tsdf.py")
    parser.add_argument("stream", help="NAME.npz with depth, K, poses and depth_scale")
    parser.add_argument("mesh", help="the mesh to write, .ply")
    parser.add_argument("--voxel", type=float, default=0.02, help="m (default: %(default)s)")
    parser.add_argument("--range", type=float, default=9.0, help="m (default: %(default)s)")
    parser.add_argument(
        "--truncation", type=float, default=4.0, help="voxels (default: %(default)s; Open3D's: 8)"
    )
    parser.add_argument(
        "--least-weight",
        type=float,
        default=1.0,
        help="observations of a voxel that the mesh needs (default: %(default)s; Open3D's: 3)",
    )
    options = parser.parse_args()

    arrays = np.load(options.stream)
    matrix = arrays["K"].astype(float)
    matrix[:2, 2] += _PIXEL_CENTER
    intrinsics = open3d.core.Tensor(matrix)
    units_per_m = float(arrays["depth_scale"])
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"),
        (open3d.core.float32, open3d.core.float32),
        ((1), (1)),
        options.voxel,
        _BLOCK,
        60_000,
        _DEVICE,
    )
    start = time.perf_counter()
    for depth, pose in zip(arrays["depth"], arrays["poses"], strict=True):
        image = open3d.t.geometry.Image(open3d.core.Tensor(np.ascontiguousarray(depth)))
        extrinsics = open3d.core.Tensor(np.linalg.inv(pose.astype(float)))
        view = (image, intrinsics, extrinsics, units_per_m, options.range)
        blocks = grid.compute_unique_block_coordinates(*view, options.truncation)
        grid.integrate(blocks, *view, options.truncation)
    frame_ms = 1e3 * (time.perf_counter() - start) / len(arrays["poses"])
    mesh = grid.extract_triangle_mesh(options.least_weight).to_legacy()
    open3d.io.write_triangle_mesh(options.mesh, mesh)
    print(f"wrote {options.mesh}: {len(mesh.triangles)} triangles, {frame_ms:.1f} ms per frame")


if __name__ == "__main__":
    main()
