"""Readers of recorded streams, one file each; `stream.Stream` is what they have in common."""

from hiosdf_jax.datasets.clouds import cloud_stream
from hiosdf_jax.datasets.kitti import kitti_stream
from hiosdf_jax.datasets.npz import NpzStream, ground_truth
from hiosdf_jax.datasets.open import FORMATS, open_stream
from hiosdf_jax.datasets.replicacad import replicacad_stream
from hiosdf_jax.datasets.rosbag import rosbag_stream
from hiosdf_jax.datasets.scannet import scannet_stream
from hiosdf_jax.datasets.stream import (
    BadFrameError,
    Extent,
    FrameStream,
    Stream,
    find_bounds,
    read_frame,
)
from hiosdf_jax.datasets.tum import tum_stream

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
