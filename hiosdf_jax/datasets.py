"""Readers of recorded streams, one file each; `stream.Stream` is what they have in common."""

from hiosdf_jax._src.datasets.clouds import cloud_stream
from hiosdf_jax._src.datasets.kitti import kitti_stream
from hiosdf_jax._src.datasets.npz import NpzStream, ground_truth
from hiosdf_jax._src.datasets.open import FORMATS, open_stream
from hiosdf_jax._src.datasets.replicacad import replicacad_stream
from hiosdf_jax._src.datasets.rosbag import rosbag_stream
from hiosdf_jax._src.datasets.scannet import scannet_stream
from hiosdf_jax._src.datasets.stream import (
    BadFrameError,
    Extent,
    FrameStream,
    Stream,
    find_bounds,
    read_frame,
)
from hiosdf_jax._src.datasets.tum import tum_stream

__all__ = [
    "FORMATS",
    "BadFrameError",
    "Extent",
    "FrameStream",
    "NpzStream",
    "Stream",
    "cloud_stream",
    "find_bounds",
    "ground_truth",
    "kitti_stream",
    "open_stream",
    "read_frame",
    "replicacad_stream",
    "rosbag_stream",
    "scannet_stream",
    "tum_stream",
]
