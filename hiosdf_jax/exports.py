"""Files of maps for other programs, and grids for other planners."""

from hiosdf_jax._src.view.exports.by_suffix import export_map
from hiosdf_jax._src.view.exports.navigation import Costmap, costmap, write_costmap
from hiosdf_jax._src.view.exports.voxels import VoxelGrid, voxel_grid

__all__ = ["Costmap", "VoxelGrid", "costmap", "export_map", "voxel_grid", "write_costmap"]
