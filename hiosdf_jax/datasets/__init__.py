"""Readers of recorded streams, one file each; `stream.Stream` is what they have in common."""

from hiosdf_jax.datasets.npz import NpzStream, ground_truth
from hiosdf_jax.datasets.stream import Extent, Stream, find_bounds

__all__ = ["Extent", "NpzStream", "Stream", "find_bounds", "ground_truth"]
