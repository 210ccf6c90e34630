"""Readers of recorded streams, one module per format, behind one protocol (`Stream`).

from hiosdf_jax import datasets

stream = datasets.open_stream("house_depth.npz")
bounds, max_range = datasets.find_bounds(stream)
"""

from hiosdf_jax._src.datasets.clouds import cloud_stream
from hiosdf_jax._src.datasets.kitti import kitti_stream
from hiosdf_jax._src.datasets.npz import NpzStream, read_truth
from hiosdf_jax._src.datasets.open import FORMATS, open_stream
from hiosdf_jax._src.datasets.replicacad import replicacad_stream
from hiosdf_jax._src.datasets.rosbag import rosbag_stream
from hiosdf_jax._src.datasets.scannet import scannet_stream
from hiosdf_jax._src.datasets.sensors import depth_to_cloud, ranges_to_cloud
from hiosdf_jax._src.datasets.stream import (
    BadFrameError,
    Extent,
    FrameStream,
    NoPosesError,
    Stream,
    find_bounds,
    read_frame,
)
from hiosdf_jax._src.datasets.trajectory import write_tum
from hiosdf_jax._src.datasets.truth import GroundTruth
from hiosdf_jax._src.datasets.tum import tum_stream

__all__ = [
    "FORMATS",
    "BadFrameError",
    "Extent",
    "FrameStream",
    "GroundTruth",
    "NoPosesError",
    "NpzStream",
    "Stream",
    "cloud_stream",
    "depth_to_cloud",
    "find_bounds",
    "kitti_stream",
    "open_stream",
    "ranges_to_cloud",
    "read_frame",
    "read_truth",
    "replicacad_stream",
    "rosbag_stream",
    "scannet_stream",
    "tum_stream",
    "write_tum",
]
