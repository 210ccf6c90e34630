"""A built-in world with exact distances: a depth camera carried through an apartment."""

from hiosdf_jax._src.demo.apartment import (
    BOUNDS_WORLD,
    ApartmentStream,
    camera_path,
    load_model,
    sample_truth,
)
from hiosdf_jax._src.demo.primitives import signed_distance

__all__ = [
    "BOUNDS_WORLD",
    "ApartmentStream",
    "camera_path",
    "load_model",
    "sample_truth",
    "signed_distance",
]
