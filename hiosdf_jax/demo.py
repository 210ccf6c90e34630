"""A built-in world with exact distances: an apartment and a depth camera carried through it."""

from hiosdf_jax._src.demo.apartment import (
    BOUNDS_WORLD,
    ApartmentStream,
    camera_path,
    ground_truth,
    load_model,
)
from hiosdf_jax._src.demo.primitives import signed_distance

__all__ = [
    "BOUNDS_WORLD",
    "ApartmentStream",
    "camera_path",
    "ground_truth",
    "load_model",
    "signed_distance",
]
